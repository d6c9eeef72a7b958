"""`recon localize`: find a drive in a map."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path
from typing import Annotated

import typer

from recon.cli import options as opt
from recon.cli.drive_options import DriveOptions, StartInMap, open_drive, read_start


@opt.takes_groups
def localize(
    source: Annotated[Path, typer.Argument(help=opt.SOURCES_HELP)],
    map_: Annotated[
        Path,
        typer.Option(
            "--map", help="The map: folder of a recon map or recon demo run, or its file."
        ),
    ],
    out: opt.Out = None,
    start: StartInMap = None,
    *,
    reading: DriveOptions,
    shared: opt.Shared,
) -> None:
    """Find a drive in a map that is there already: the pose of each frame.

    The first frames are recognised by the keyframes of the map, later ones
    tracked against its features and surfaces. Frames are searching (no pose),
    tracking (the map confirms the pose), coasting (the pose is by odometry alone,
    for some metres at most) or lost (no pose any more). The map is not changed.

    Examples:
      recon localize rides/today --map outputs/map/latest
      recon localize rides/today --map outputs/map/latest --start 12.5,-3,90
    """
    with shared.one_line_errors():
        from recon.commands.localize import run_localize
        from recon.commands.map_options import MapRequest

        pose, first = read_start(start)
        settings = reading.settings(shared, first)
        request = MapRequest(source, reading.kind)
        drive, options = open_drive(request, settings, shared)
        options = replace(options, command="localize", out=out, threads=shared.threads)
        run = run_localize(drive, map_, settings, options, start=pose)
    shared.show(run.summary)
