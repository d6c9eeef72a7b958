"""`recon export`: products of a finished run."""

from __future__ import annotations

import math
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from recon.cli import options as opt
from recon.cli.drive_options import open_workers
from recon.core.errors import SettingsError

if TYPE_CHECKING:
    from recon.export.survey import Survey


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
    antenna: Annotated[
        str | None,
        typer.Option(
            metavar="X,Y,Z",
            help="Where that antenna or prism is, from the left camera: metres forward, left, up.",
            show_default="0,0,0",
        ),
    ] = None,
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
            survey=_survey(georeference, antenna, crs),
        )
    shared.show(summary)


def _survey(positions: Path | None, antenna: str | None, crs: str | None) -> Survey | None:
    """Return what the options say of a survey.

    Raises:
        SettingsError: The offset is not three numbers, or there are no positions.
    """
    from recon.export.survey import Survey

    if positions is None:
        if antenna is None and crs is None:
            return None
        given = "--crs" if antenna is None else "--antenna"
        raise SettingsError(
            "there are no positions that it describes", where=given, expected="--georeference FILE"
        )
    offset = opt.parse_numbers(antenna or "0,0,0", "--antenna")
    if offset is None or len(offset) != 3 or not all(map(math.isfinite, offset)):
        raise SettingsError("not three numbers", where="--antenna", got=antenna, expected="X,Y,Z")
    return Survey(positions, (offset[0], offset[1], offset[2]), crs)
