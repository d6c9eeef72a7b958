"""`recon localize`: find a drive in a map."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path
from typing import Annotated

import typer

from recon.cli.options import (
    SOURCES_HELP,
    Calib,
    Config,
    End,
    Json,
    LeftView,
    Matcher,
    MemoryLimit,
    Out,
    Quiet,
    RightView,
    Set,
    SourceKind,
    Stride,
    Threads,
    Tolerance,
    Verbose,
)
from recon.cli.session import session
from recon.cli.show.tables import print_json, print_run
from recon.cli.start_pose import StartInMap, read_start


def localize(
    source: Annotated[Path, typer.Argument(help=SOURCES_HELP)],
    map_: Annotated[
        Path,
        typer.Option(
            "--map", help="The map: folder of a recon map or recon demo run, or its file."
        ),
    ],
    out: Out = None,
    kind: SourceKind = None,
    calib: Calib = None,
    left: LeftView = None,
    right: RightView = None,
    tolerance: Tolerance = None,
    start: StartInMap = None,
    end: End = None,
    stride: Stride = None,
    matcher: Matcher = None,
    memory_limit: MemoryLimit = None,
    config: Config = None,
    set_: Set = None,
    json: Json = False,
    quiet: Quiet = False,
    verbose: Verbose = False,
    threads: Threads = None,
) -> None:
    """Find a drive in a map that is there already: the pose of each frame.

    The first frames are recognised by the keyframes of the map, later ones
    tracked against its features and surfaces. Frames are searching, tracking or
    lost; only those that are tracked have a pose. The map is not changed.

    Examples:
      recon localize rides/today --map outputs/map/latest
      recon localize rides/today --map outputs/map/latest --start 12.5,-3,90
    """
    with session(quiet=quiet):
        from recon.cli.show.announce import announce
        from recon.cli.show.progress import choose_viewer
        from recon.commands.config import load_config, matching_overrides, source_overrides
        from recon.commands.localize import run_localize
        from recon.commands.map_options import MapRequest
        from recon.run.memory import memory_overrides

        pose, first = read_start(start)
        views = source_overrides(calib, left, right, tolerance, (first, end, stride))
        overrides = [*(set_ or ()), *matching_overrides(matcher), *views]
        settings = load_config(config, [*overrides, *memory_overrides(memory_limit)])
        drive, options = MapRequest(source, kind).open(settings)
        announce(drive, quiet=quiet, verbose=verbose)
        viewer = choose_viewer(quiet=quiet, verbose=verbose)
        options = replace(options, command="localize", out=out, threads=threads, progress=viewer)
        run = run_localize(drive, map_, settings, options, start=pose)
    print_json(run.summary) if json else print_run(run.summary, stages=verbose)
