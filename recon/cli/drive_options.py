"""What commands that take a drive share: how it is read, opened, and where it begins in a map."""

from __future__ import annotations

import math
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer

from recon.cli import options as opt
from recon.cli.options import setting
from recon.core.errors import SettingsError

if TYPE_CHECKING:
    from recon.commands.config import ReconConfig
    from recon.commands.map_options import MapOptions
    from recon.map.localize.sequence import StartPose
    from recon.run.batch.cluster import BatchOptions
    from recon.sources.source import StereoSource


def _first_frame(text: str) -> dict[str, Any]:
    _, frame = read_start(text)
    return {} if frame is None else {"source.start": frame}


def _memory_limit(text: str) -> dict[str, Any]:
    from recon.core.machine import parse_size_mb

    return {"memory.limit_mb": parse_size_mb(text)}


Start = Annotated[int | None, setting("source.start", "First frame to use.", default="0")]
StartInMap = Annotated[
    str | None,
    setting(
        _first_frame,
        "Where the drive begins in map axes: metres, degrees from x to y; or its first frame.",
        default="anywhere in the map, frame 0",
        metavar="X,Y,YAW|FRAME",
    ),
]


@dataclass(frozen=True)
class RectifiedOptions:
    """What is known of cameras whose images are rectified, without a calibration file."""

    focal: Annotated[
        float | None,
        setting("source.focal_px", "Focal length if rectified, without --calib.", metavar="PX"),
    ] = None
    baseline: Annotated[
        float | None,
        setting("source.baseline_m", "Distance between their cameras in metres.", metavar="M"),
    ] = None
    cx: Annotated[
        float | None, setting("source.cx_px", "Column of their principal points.", default="middle")
    ] = None
    cy: Annotated[
        float | None, setting("source.cy_px", "Row of their principal points.", default="middle")
    ] = None


@dataclass(frozen=True)
class SourceOptions(RectifiedOptions):
    """How the pairs of a source are found, where its files leave that open."""

    kind: Annotated[
        str | None,
        opt.option(
            "Kind, else detected: kitti, kitti-raw, euroc, tum, rgbd, folders, video, bag, "
            "middlebury.",
            "--source",
        ),
    ] = None
    calib: Annotated[
        Path | None,
        setting("source.calibration", "Calibration file.", default="that of the source"),
    ] = None
    left: Annotated[
        str | None, setting("source.left", "Left image folder or topic.", default="found by name")
    ] = None
    right: Annotated[
        str | None,
        setting(
            "source.right", "Right image folder or topic, or right video.", default="found by name"
        ),
    ] = None
    tolerance: Annotated[
        float | None,
        setting(
            "source.tolerance_s", "Largest time difference of a pair, in seconds.", default="0.01"
        ),
    ] = None
    end: Annotated[
        int | None, setting("source.end", "Frame at which to stop.", default="after the last")
    ] = None
    stride: Annotated[
        int | None, setting("source.stride", "Use every so many frames.", default="1")
    ] = None


@dataclass(frozen=True)
class DriveOptions(SourceOptions):
    """How a drive is read and matched, and how much memory that may take."""

    matcher: opt.Matcher = None
    memory_limit: Annotated[
        str | None,
        setting(
            _memory_limit, "Memory limit, e.g. 2G. A run that exceeds it stops, and can be resumed."
        ),
    ] = None


def open_drive(
    options: MapOptions, settings: ReconConfig, shared: opt.Shared
) -> tuple[StereoSource, MapOptions]:
    """Open a drive, say how it is read, and return it with the options of its run."""
    from recon.cli.progress import announce
    from recon.core.progress import stage

    stage(f"open {options.source}")
    drive, options = options.open(settings)
    announce(drive, quiet=shared.quiet, verbose=shared.verbose)
    return drive, options


def open_workers(
    workers: int | None, scheduler: str | None, shared: opt.Shared
) -> BatchOptions | None:
    """Return where work is shared by several processes, shown on standard error; None = nowhere."""
    from recon.run.batch.cluster import BatchOptions

    if scheduler is not None and workers is not None:
        raise typer.BadParameter("--scheduler has workers of its own; drop --workers")
    if scheduler is None and (workers or 1) == 1:
        return None
    return BatchOptions(None, scheduler, workers)


def read_start(text: str | None) -> tuple[StartPose | None, int | None]:
    """Read where a drive begins: a pose ``x,y,yaw``, or the number of its first frame."""
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
