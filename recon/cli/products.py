"""`recon export`: products of a finished run."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer

from recon.cli import options as opt
from recon.cli.drive_options import open_workers
from recon.core.errors import SettingsError
from recon.core.text import parse_number

Resolution = Annotated[
    float | None,
    opt.setting("occupancy.resolution_m", "Cell size in metres.", default="as in the run"),
]


def _bands(text: str) -> dict[str, list[list[float]]]:
    try:
        ends = [one.split(":") for one in text.split(",")]
        bands = [[parse_number(low), parse_number(high)] for low, high in ends]
    except ValueError as error:
        what, expected = "not bands of heights", "0.1:0.5,0.5:2"
        raise SettingsError(what, where="--heights", got=text, expected=expected) from error
    return {"grid.heights_m": bands}


Heights = Annotated[
    str | None,
    opt.setting(
        _bands,
        "Grids of other bands of heights besides, such as 0.1:0.5,0.5:2 (metres above ground).",
        metavar="LOW:HIGH,…",
    ),
]


@opt.takes_groups
def export(
    run: Annotated[Path, typer.Argument(help="Folder of a run of map, demo or pair.")],
    to: Annotated[
        list[str] | None,
        opt.option(
            "cloud, grid, octomap, mesh; costmap (Nav2), esdf (distances, NumPy); for surveying "
            "programs las, laz, copc, e57, contours (GeoPackage), and dsm, dtm, slope, orthophoto, "
            "grid-geotiff (GeoTIFF); pcd (PCL), npz (NumPy), mcap, gridmap (ROS 2), colmap, "
            "nerfstudio, texture, web (a page for any server); several with commas.",
            default="the first four",
        ),
    ] = None,
    out: opt.Out = None,
    formats: opt.Formats = None,
    resolution: Resolution = None,
    heights: Heights = None,
    georeference: Annotated[
        Path | None,
        opt.option(
            "Measured positions, in whose coordinates those for surveying programs are written, "
            "with accuracy.html." + opt.POSITIONS
        ),
    ] = None,
    antenna: opt.Antenna = None,
    crs: Annotated[
        str | None, opt.option("Coordinate system of the positions, such as EPSG:25832.")
    ] = None,
    images: Annotated[
        list[Path] | None,
        opt.option("The drive whose images are needed.", default="where it was mapped"),
    ] = None,
    gsd: Annotated[
        float | None,
        opt.option(
            "Cell size of the orthophoto in metres.", metavar="METRES", default="that of the images"
        ),
    ] = None,
    workers: opt.Workers = None,
    scheduler: opt.Scheduler = None,
    *,
    shared: opt.Shared,
) -> None:
    """Make the cloud, grid, OctoMap or mesh of a run again, with other settings or formats.

    Nothing is matched again (but for nerfstudio and control points): products
    are made from the cloud and the rays that the run has kept. Settings of
    occupancy, grid, ground, robot, submaps and mesh can be changed; all others
    are those of the run.

    Examples:
      recon export outputs/map/latest --to grid,mesh --format glb --out robot
      recon export outputs/map/latest --to grid --heights 0.1:0.5,0.5:2
      recon export outputs/map/latest --to esdf --resolution 0.1
      recon export outputs/map/latest --to mesh --set mesh.depth=9
      recon export outputs/site --to laz --georeference gnss.txt --crs EPSG:25832
      recon export outputs/site --to dsm,orthophoto --resolution 0.1 --gsd 0.03
      recon export outputs/city --to grid,octomap --workers 4
    """
    with shared.one_line_errors():
        from recon.commands.config import run_settings
        from recon.commands.export import run_export

        summary = run_export(
            run,
            run_settings(run, shared.config, shared.changes, preset=shared.preset),
            products=opt.names_in(to),
            formats=opt.names_in(formats) or ("ply",),
            out=out,
            threads=shared.threads,
            workers=open_workers(workers, scheduler, shared),
            survey=opt.survey_of(georeference, antenna, crs),
            images=images or (),
            gsd_m=gsd,
        )
    shared.show(summary)


@opt.takes_groups
def mesh(
    source: Annotated[
        Path,
        typer.Argument(
            metavar="CLOUD|RUN",
            help="PLY point cloud (normals and colours are used), or the folder of a run.",
        ),
    ],
    out: opt.Out = None,
    formats: opt.Formats = None,
    *,
    shared: opt.Shared,
) -> None:
    """Reconstruct a surface mesh from a PLY point cloud, or from a run of map or pair.

    A cloud gets MeshLab's screened Poisson reconstruction, trimmed where there
    are no points. The map of a run is meshed in tiles, through the points of its
    voxels, without surfaces in space that the cameras saw to be free. The cloud
    of a pair is meshed as recon pair does.

    Examples:
      recon mesh cloud.ply --format obj --format glb
      recon mesh outputs/map/latest --set mesh.target_faces=500000
    """
    with shared.one_line_errors():
        from recon.commands.config import PAIR_DEFAULTS
        from recon.commands.export import run_mesh
        from recon.run.finished import is_pair_run

        defaults = PAIR_DEFAULTS if source.is_dir() and is_pair_run(source) else None
        settings = shared.settings(defaults)
        summary = run_mesh(
            source,
            settings,
            formats=opt.names_in(formats) or ("ply",),
            out=out,
            threads=shared.threads,
        )
    shared.show(summary)


@opt.takes_groups
def occupancy(
    run: Annotated[Path, typer.Argument(help="Folder of a recon map or recon demo run.")],
    out: opt.Out = None,
    resolution: Resolution = None,
    min_height: Annotated[
        float | None,
        opt.setting(
            "grid.min_height_m", "Lower end of the band of obstacles, in metres above ground."
        ),
    ] = None,
    max_height: Annotated[
        float | None, opt.setting("grid.max_height_m", "Upper end of the band, in metres.")
    ] = None,
    heights: Heights = None,
    max_range: Annotated[
        float | None,
        opt.setting("occupancy.max_range_m", "Ignore obstacles farther than this, in metres."),
    ] = None,
    *,
    shared: opt.Shared,
) -> None:
    """Make another Nav2 grid and OctoMap of a run: cell size, height band, range.

    Uses the rays that the run has kept in map/map.recon, so that nothing is
    matched again.

    Examples:
      recon occupancy outputs/map/latest --resolution 0.1
      recon occupancy outputs/map/latest --min-height 0.5 --max-height 3.2
    """
    with shared.one_line_errors():
        from recon.commands.config import run_settings
        from recon.commands.export import run_occupancy

        settings = run_settings(run, shared.config, shared.changes, preset=shared.preset)
        summary = run_occupancy(run, settings, out=out, threads=shared.threads)
    shared.show(summary)


@opt.takes_groups
def volume(
    run: Annotated[Path, typer.Argument(help="Folder of a finished run, or its map file.")],
    other: Annotated[
        Path | None, typer.Argument(help="That of a later run through the same place.")
    ] = None,
    height: Annotated[
        float | None,
        opt.option("Compare with a level plane there, metres in the map.", min=-1e4, max=1e4),
    ] = None,
    within: Annotated[
        str | None,
        opt.option("Only there, metres in the map.", metavar="X0,Y0,X1,Y1", default="everywhere"),
    ] = None,
    *,
    shared: opt.Shared,
) -> None:
    """Measure what was dug and heaped up between two runs, or above a plane.

    The uppermost points in cells of the grid are compared; cells that one of both
    lacks are counted, and left out. The standard deviation is that of the points,
    and of how far two maps differ where nothing changed. A plane is exact.

    Examples:
      recon volume outputs/monday outputs/friday --within 10,-5,25,5
      recon volume outputs/yard --height=-1.6 --within 10,-5,25,5 --json
    """
    if shared.config is not None or shared.preset is not None or shared.changes:
        raise typer.BadParameter("runs are compared as the first was mapped: no --config, --set")
    with shared.one_line_errors():
        from recon.commands.volume import run_volume

        ends = None if within is None else opt.parse_numbers(within, "--within")
        summary = run_volume(run, other, height_m=height, within_m=ends, threads=shared.threads)
    shared.show(summary)
