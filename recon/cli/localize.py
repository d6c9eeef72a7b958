"""`recon localize`: find a drive in a map."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path
from typing import Annotated

import typer

from recon.cli import options as opt
from recon.cli.drive import StartInMap, open_drive, read_start


@opt.takes_shared
def localize(
    source: Annotated[Path, typer.Argument(help=opt.SOURCES_HELP)],
    map_: Annotated[
        Path,
        typer.Option(
            "--map", help="The map: folder of a recon map or recon demo run, or its file."
        ),
    ],
    out: opt.Out = None,
    kind: opt.SourceKind = None,
    calib: opt.Calib = None,
    left: opt.LeftView = None,
    right: opt.RightView = None,
    tolerance: opt.Tolerance = None,
    start: StartInMap = None,
    end: opt.End = None,
    stride: opt.Stride = None,
    matcher: opt.Matcher = None,
    memory_limit: opt.MemoryLimit = None,
    *,
    shared: opt.Shared,
) -> None:
    """Find a drive in a map that is there already: the pose of each frame.

    The first frames are recognised by the keyframes of the map, later ones
    tracked against its features and surfaces. Frames are searching, tracking or
    lost; only those that are tracked have a pose. The map is not changed.

    Examples:
      recon localize rides/today --map outputs/map/latest
      recon localize rides/today --map outputs/map/latest --start 12.5,-3,90
    """
    with shared.session():
        from recon.commands.config import load_config, matching_overrides, source_overrides
        from recon.commands.localize import run_localize
        from recon.commands.map_options import MapRequest
        from recon.run.memory import memory_overrides

        pose, first = read_start(start)
        views = source_overrides(calib, left, right, tolerance, (first, end, stride))
        overrides = [*shared.changes, *matching_overrides(matcher), *views]
        settings = load_config(shared.config, [*overrides, *memory_overrides(memory_limit)])
        request = MapRequest(source, kind)
        drive, options = open_drive(request, settings, shared)
        options = replace(options, command="localize", out=out, threads=shared.threads)
        run = run_localize(drive, map_, settings, options, start=pose)
    shared.show(run.summary)
