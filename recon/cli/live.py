"""`recon live`: map a drive, or find it in a map, while its images arrive."""

from __future__ import annotations

from contextlib import ExitStack
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from recon.cli import options as opt
from recon.cli.drive_options import DriveOptions, StartInMap, open_drive, read_start
from recon.cli.errors import until_interrupted

if TYPE_CHECKING:
    from recon.sources.source import StereoSource


@opt.takes_groups
def live(
    source: Annotated[
        str,
        typer.Argument(
            help="Left camera (0, /dev/video0, address of a stream) or one that has both views; or "
            "a recording. " + opt.SOURCES_HELP
        ),
    ],
    right_camera: Annotated[
        str | None, typer.Argument(help="Right camera, or the right video as if it were one.")
    ] = None,
    rate: Annotated[
        float, typer.Option(help="How many times as fast as recorded a recording is played.")
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
    start: StartInMap = None,
    mesh: opt.Mesh = False,
    *,
    reading: DriveOptions,
    shared: opt.Shared,
) -> None:
    """Map a drive while its images arrive, from cameras or from a recording.

    A recording is played at its time stamps. The pose of each frame comes first;
    matching follows as far as there is time. Where even poses take too long,
    frames are dropped. summary.json counts both, and the time from an image to
    its pose. Ctrl-C ends the drive, and its map is completed.

    Examples:
      recon live 0 2 --calib stereo.yaml
      recon live rides/today --rate 2
      recon live rides/today --map outputs/map/latest
    """
    with shared.one_line_errors(), ExitStack() as stack:
        from recon.cli.progress import announce
        from recon.commands.localize import run_live
        from recon.rig.cameras import is_camera, open_camera_source

        stopped = stack.enter_context(until_interrupted())
        pose, _ = read_start(start)
        settings = shared.settings()
        options = shared.options("live", out, mesh=mesh, source=source, kind=reading.kind)
        drive: StereoSource
        if right_camera is not None or is_camera(source):
            devices = [source] if right_camera is None else [source, right_camera]
            cameras = open_camera_source(devices, settings.capture, settings.source, stopped)
            drive = stack.enter_context(cameras)
            announce(drive, quiet=shared.quiet, verbose=shared.verbose)
        else:
            drive, options = open_drive(options, settings, shared)
        summary = run_live(
            drive, settings, options, rate=rate, map_path=map_, start=pose, stopped=stopped
        )
    shared.show(summary)


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

        pose, _ = read_start(start)
        settings = shared.settings()
        options = shared.options("localize", out, source=source, kind=reading.kind)
        drive, options = open_drive(options, settings, shared)
        run = run_localize(drive, map_, settings, options, start=pose)
    shared.show(run.summary)
