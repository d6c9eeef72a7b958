"""What commands that take a drive share: how it is opened, and where it begins in a map."""

from __future__ import annotations

import math
from dataclasses import replace
from typing import TYPE_CHECKING, Annotated

import typer

from recon.cli import options as opt
from recon.core.errors import SettingsError

if TYPE_CHECKING:
    from recon.commands.config import ReconConfig
    from recon.commands.map_options import MapOptions, MapRequest
    from recon.map.localize.sequence import StartPose
    from recon.run.batch.work import BatchOptions
    from recon.sources.protocol import StereoSource

StartInMap = Annotated[
    str | None,
    typer.Option(
        "--start",
        metavar="X,Y,YAW|FRAME",
        help="Where the drive begins in map axes, if known: metres, and degrees from x to y. "
        "A single number is the first frame to use.",
        show_default="anywhere in the map, frame 0",
    ),
]


def open_drive(
    request: MapRequest, settings: ReconConfig, shared: opt.Shared
) -> tuple[StereoSource, MapOptions]:
    """Open a drive, say how it is read, and return it with the options of its run.

    Raises:
        ReconError: It cannot be opened.
    """
    drive, options = request.open(settings)
    return drive, announced(drive, options, shared)


def announced(drive: StereoSource, options: MapOptions, shared: opt.Shared) -> MapOptions:
    """Say how a drive is read, and return the options of its run with a progress that is shown."""
    from recon.cli.show.announce import announce

    announce(drive, quiet=shared.quiet, verbose=shared.verbose)
    return replace(options, progress=shared.viewer())


def open_workers(
    workers: int | None, scheduler: str | None, shared: opt.Shared
) -> BatchOptions | None:
    """Return where work is shared by several processes, shown on standard error; None = nowhere."""
    from recon.cli.show.jobs import choose_job_viewer
    from recon.run.batch.work import BatchOptions

    if scheduler is not None and workers is not None:
        raise typer.BadParameter("--scheduler has workers of its own; drop --workers")
    if scheduler is None and (workers or 1) == 1:
        return None
    viewer = choose_job_viewer(quiet=shared.quiet, verbose=shared.verbose)
    return BatchOptions(None, scheduler, workers, progress=viewer, tell=viewer.on_job)


def read_start(text: str | None) -> tuple[StartPose | None, int | None]:
    """Read where a drive begins: a pose ``x,y,yaw``, or the number of its first frame.

    Raises:
        SettingsError: It is neither.
    """
    numbers = opt.parse_numbers(text, "--start") or ()
    if not numbers:
        return None, None
    if len(numbers) == 3 and all(map(math.isfinite, numbers)):
        from recon.map.localize.sequence import StartPose

        return StartPose(*numbers), None
    if len(numbers) == 1 and numbers[0].is_integer():
        return None, int(numbers[0])
    raise SettingsError(
        "not a pose, nor the number of a frame",
        where="--start",
        got=text,
        expected="x,y,yaw in metres and degrees, such as 12.5,-3,90; or one whole number",
    )
