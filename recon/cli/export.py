"""`recon export`: products of a finished run."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer

from recon.cli import options as opt
from recon.cli.drive_options import open_workers


@opt.takes_groups
def export(
    run: Annotated[Path, typer.Argument(help="Folder of a run of map, demo or pair.")],
    to: Annotated[
        list[str] | None,
        typer.Option(
            help="What to make: cloud, grid, octomap, mesh, and on request las or laz, the cloud "
            "for surveying programs; several separated by commas. A pair has cloud and mesh.",
            show_default="cloud, grid, octomap, mesh",
        ),
    ] = None,
    out: opt.Out = None,
    formats: opt.Formats = None,
    resolution: Annotated[
        float | None,
        typer.Option(help="Cell size of grid and OctoMap in metres.", show_default="as in the run"),
    ] = None,
    georeference: Annotated[
        Path | None,
        typer.Option(
            help="Measured positions, in whose coordinates las and laz are written: rows of time, "
            "easting, northing and height (s, m), on the clock of the images.",
            show_default="map coordinates",
        ),
    ] = None,
    antenna: opt.Antenna = None,
    crs: Annotated[
        str | None,
        typer.Option(
            help="Coordinate system of the positions, such as EPSG:25832.",
            show_default="not stated",
        ),
    ] = None,
    workers: opt.Workers = None,
    scheduler: opt.Scheduler = None,
    *,
    shared: opt.Shared,
) -> None:
    """Make the cloud, grid, OctoMap or mesh of a run again, with other settings or formats.

    Nothing is matched again: products are made from the cloud and the rays that
    the run has kept, in one pass. Settings of occupancy, grid, ground, submaps
    and mesh can be changed; all others are those of the run.

    Examples:
      recon export outputs/map/latest --to grid,mesh --format glb --out robot
      recon export outputs/map/latest --to grid --set grid.max_height_m=3.2
      recon export outputs/map/latest --to mesh --set mesh.depth=9
      recon export outputs/site --to laz --georeference gnss.txt --crs EPSG:25832
      recon export outputs/city --to grid,octomap --workers 4
    """
    with shared.one_line_errors():
        from recon.commands.config import run_settings
        from recon.commands.export import run_export

        cells = [] if resolution is None else [f"occupancy.resolution_m={resolution}"]
        summary = run_export(
            run,
            run_settings(run, shared.config, [*shared.changes, *cells]),
            products=[name.strip() for text in to or () for name in text.split(",")],
            formats=tuple(formats or ("ply",)),
            out=out,
            threads=shared.threads,
            workers=open_workers(workers, scheduler, shared),
            survey=opt.survey_of(georeference, antenna, crs),
        )
    shared.show(summary)
