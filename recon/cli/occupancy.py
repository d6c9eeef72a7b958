"""`recon occupancy`: other occupancy maps of a mapped drive."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer

from recon.cli import options as opt


@opt.takes_groups
def occupancy(
    run: Annotated[Path, typer.Argument(help="Folder of a recon map or recon demo run.")],
    out: opt.Out = None,
    resolution: Annotated[
        float | None, typer.Option(help="Cell size in metres.", show_default="as in the run")
    ] = None,
    min_height: Annotated[
        float | None,
        typer.Option(help="Lower end of the obstacle height band, in metres above ground."),
    ] = None,
    max_height: Annotated[
        float | None, typer.Option(help="Upper end of the band, in metres.")
    ] = None,
    max_range: Annotated[
        float | None,
        typer.Option(help="Ignore obstacles farther than this from the camera, in metres."),
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
        from recon.commands.occupancy import run_occupancy

        given = {
            "occupancy.resolution_m": resolution,
            "grid.min_height_m": min_height,
            "grid.max_height_m": max_height,
            "occupancy.max_range_m": max_range,
        }
        named = [f"{key}={value}" for key, value in given.items() if value is not None]
        settings = run_settings(run, shared.config, [*shared.changes, *named])
        summary = run_occupancy(run, settings, out=out, threads=shared.threads)
    shared.show(summary)
