"""What commands that take a drive share: how it is read, opened, and where it begins in a map."""

from __future__ import annotations

import json
import math
from dataclasses import dataclass, replace
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from recon.cli import options as opt
from recon.core.errors import SettingsError

if TYPE_CHECKING:
    from recon.commands.config import ReconConfig
    from recon.commands.map_options import MapOptions, MapRequest
    from recon.map.localize.sequence import StartPose
    from recon.run.batch.cluster import BatchOptions
    from recon.sources.source import StereoSource

Start = Annotated[int | None, typer.Option("--start", help="First frame to use.", show_default="0")]
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


@dataclass(frozen=True)
class RectifiedOptions:
    """What is known of cameras whose images are rectified, without a calibration file."""

    focal: Annotated[
        float | None,
        typer.Option(
            metavar="PX",
            help="Focal length of images that are rectified already, without --calib.",
            show_default="that of the calibration",
        ),
    ] = None
    baseline: Annotated[
        float | None,
        typer.Option(
            metavar="M",
            help="Distance between their cameras in metres.",
            show_default="that of the calibration",
        ),
    ] = None
    cx: Annotated[
        float | None,
        typer.Option(metavar="PX", help="Column of their principal points.", show_default="middle"),
    ] = None
    cy: Annotated[
        float | None, typer.Option(metavar="PX", help="Row of it.", show_default="middle")
    ] = None

    @property
    def numbers(self) -> list[str]:
        """The settings that they stand for."""
        given = {
            "focal_px": self.focal,
            "baseline_m": self.baseline,
            "cx_px": self.cx,
            "cy_px": self.cy,
        }
        return [f"source.{key}={value}" for key, value in given.items() if value is not None]


@dataclass(frozen=True)
class SourceOptions(RectifiedOptions):
    """How the pairs of a source are found, where its files leave that open."""

    kind: Annotated[
        str | None,
        typer.Option(
            "--source",
            help="Kind of source: kitti, kitti-raw, euroc, tum, folders, video, bag or middlebury.",
            show_default="detected from its files",
        ),
    ] = None
    calib: Annotated[
        Path | None,
        typer.Option(help="Calibration file.", show_default="the one that comes with the source"),
    ] = None
    left: Annotated[
        str | None, typer.Option(help="Left image folder or topic.", show_default="found by name")
    ] = None
    right: Annotated[
        str | None,
        typer.Option(
            help="Right image folder or topic, or the right video where SOURCE is the left one.",
            show_default="found by name",
        ),
    ] = None
    tolerance: Annotated[
        float | None,
        typer.Option(
            help="Largest difference between the time stamps of a pair, in seconds.",
            show_default="0.01",
        ),
    ] = None
    end: Annotated[
        int | None, typer.Option(help="Frame at which to stop.", show_default="after the last")
    ] = None
    stride: Annotated[
        int | None, typer.Option(help="Use every so many frames.", show_default="1")
    ] = None

    def overrides(self, start: int | None) -> list[str]:
        """Return the settings that they stand for.

        Args:
            start: First frame to use; None = unchanged, like the options.
        """
        given = {
            "calibration": None if self.calib is None else str(self.calib),
            "left": self.left,
            "right": self.right,
            "tolerance_s": self.tolerance,
            "start": start,
            "end": self.end,
            "stride": self.stride,
        }
        # Quoted, since a topic or folder may be named 0 or null.
        quoted = {key: json.dumps(value) for key, value in given.items() if value is not None}
        return [*self.numbers, *(f"source.{key}={text}" for key, text in quoted.items())]


@dataclass(frozen=True)
class DriveOptions(SourceOptions):
    """How a drive is read and matched, and how much memory that may take."""

    matcher: opt.Matcher = None
    memory_limit: Annotated[
        str | None,
        typer.Option(
            help="Memory limit of the process, e.g. 2G or 1500M. A run that exceeds it stops and "
            "can be resumed.",
            show_default="none",
        ),
    ] = None

    def overrides(self, start: int | None) -> list[str]:
        """Return the settings that all but the memory limit stand for; see `SourceOptions`."""
        from recon.cli.overrides import matching_overrides

        return [*matching_overrides(self.matcher), *super().overrides(start)]

    def settings(self, shared: opt.Shared, start: int | None) -> ReconConfig:
        """Return the configuration of a command."""
        from recon.commands.config import load_config
        from recon.run.memory import memory_overrides

        limit = memory_overrides(self.memory_limit)
        return load_config(shared.config, [*shared.changes, *self.overrides(start), *limit])


def open_drive(
    request: MapRequest, settings: ReconConfig, shared: opt.Shared
) -> tuple[StereoSource, MapOptions]:
    """Open a drive, say how it is read, and return it with the options of its run."""
    drive, options = request.open(settings)
    return drive, announced(drive, options, shared)


def announced(drive: StereoSource, options: MapOptions, shared: opt.Shared) -> MapOptions:
    """Say how a drive is read, and return the options of its run with a progress that is shown."""
    from recon.cli.progress import announce

    announce(drive, quiet=shared.quiet, verbose=shared.verbose)
    return replace(options, progress=shared.viewer())


def open_workers(
    workers: int | None, scheduler: str | None, shared: opt.Shared
) -> BatchOptions | None:
    """Return where work is shared by several processes, shown on standard error; None = nowhere."""
    from recon.run.batch.cluster import BatchOptions

    if scheduler is not None and workers is not None:
        raise typer.BadParameter("--scheduler has workers of its own; drop --workers")
    if scheduler is None and (workers or 1) == 1:
        return None
    return BatchOptions(None, scheduler, workers, progress=shared.viewer())


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
