"""`recon live`: map a drive, or find it in a map, while its images arrive."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path
from typing import Annotated

import typer

from recon.cli import options as opt
from recon.cli.drive import StartInMap, open_drive, read_start
from recon.cli.session import session
from recon.cli.show.tables import print_json, print_run


def live(
    source: Annotated[Path, typer.Argument(help=opt.SOURCES_HELP)],
    rate: Annotated[
        float, typer.Option(help="How many times as fast as recorded the source is played.")
    ] = 1.0,
    map_: Annotated[
        Path | None,
        typer.Option(
            "--map",
            help="Find the drive in this map, a run folder or a map file, and make none.",
            show_default="make a map",
        ),
    ] = None,
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
    mesh: opt.Mesh = False,
    memory_limit: opt.MemoryLimit = None,
    config: opt.Config = None,
    set_: opt.Set = None,
    json: opt.Json = False,
    quiet: opt.Quiet = False,
    verbose: opt.Verbose = False,
    threads: opt.Threads = None,
) -> None:
    """Map a drive while its images arrive: the source is played at its time stamps.

    Where the machine is too slow, frames are tracked without being matched, and
    if that does not help, dropped: summary.json counts both, and the time from
    an image to its pose. With --map the drive is found in that map instead.

    Examples:
      recon live rides/today
      recon live rides/today --rate 2
      recon live rides/today --map outputs/map/latest
    """
    with session(quiet=quiet):
        from recon.commands.config import load_config, matching_overrides, source_overrides
        from recon.commands.live import run_live
        from recon.commands.map_options import MapRequest
        from recon.run.memory import memory_overrides

        pose, first = read_start(start)
        views = source_overrides(calib, left, right, tolerance, (first, end, stride))
        overrides = [*(set_ or ()), *matching_overrides(matcher), *views]
        settings = load_config(config, [*overrides, *memory_overrides(memory_limit)])
        request = MapRequest(source, kind, mesh=mesh)
        drive, options = open_drive(request, settings, quiet=quiet, verbose=verbose)
        options = replace(options, command="live", out=out, threads=threads)
        summary = run_live(drive, settings, options, rate=rate, map_path=map_, start=pose)
    print_json(summary) if json else print_run(summary, stages=verbose)
