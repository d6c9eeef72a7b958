"""Records from two cameras, or from one that gives both views side by side.

Both cameras are grabbed before either frame is decoded, to keep the exposures close. Recordings
have the layout of plain folders (see `folders`); the line of a pair in ``frames.csv`` is written
last and marks it as complete.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable, Iterator
from contextlib import ExitStack, contextmanager
from dataclasses import dataclass
from typing import Final, Literal

import numpy as np
from pydantic import Field

from recon.core.errors import SourceError
from recon.core.settings import Settings
from recon.core.values.arrays import UInt8
from recon.sources.opencv_camera import Camera, OpenCvCamera
from recon.sources.settings import SourceSettings
from recon.sources.video import split_views

# Assumed if a driver does not report its rate; the most common one.
_USUAL_RATE_HZ: Final = 30.0


_WARM_UP_FRAMES: Final = 15
"""Frames dropped at the start, while the exposure adapts."""


class CaptureSettings(Settings):
    """Settings of a recording."""

    width_px: int | None = Field(
        default=None,
        ge=16,
        le=100_000,
        description="Requested frame width. none = the driver's default.",
    )
    height_px: int | None = Field(
        default=None, ge=16, le=100_000, description="Requested frame height; with width_px."
    )
    rate_hz: float | None = Field(
        default=None,
        ge=1e-3,
        le=1e6,
        description="Requested frame rate. none = the driver's default.",
    )
    lock_exposure: bool = Field(
        default=True,
        description="Lock exposure and white balance if the driver supports it. Turn it off where "
        "the light changes during the drive.",
    )
    side_by_side: Literal["left-right", "right-left", "top-bottom", "bottom-top"] = Field(
        default="left-right", description="Arrangement of the views in the frames of one device."
    )
    suffix: Literal["png", "jpg"] = Field(
        default="png", description="File format: png = lossless, jpg = for a slow disk."
    )


class RecordingSettings(CaptureSettings):
    """The settings of one recording, and when it ends."""

    frames: int | None = Field(
        default=None, ge=1, le=1_000_000_000, description="Stop after this many pairs."
    )
    seconds: float | None = Field(
        default=None, ge=1e-3, le=1e9, description="Stop after this many seconds."
    )
    preview_every: int | None = Field(
        default=None,
        ge=1,
        le=1_000_000_000,
        description="Update preview.jpg every N pairs. None = no preview.",
    )


@dataclass(frozen=True, eq=False)
class CapturedPair:
    """One pair of frames from the cameras.

    Attributes:
        left: Left image, uint8 (H, W, 3) RGB.
        right: Right image, likewise.
        left_s: Time of the left image.
        right_s: Time of the right image.
    """

    left: UInt8
    right: UInt8
    left_s: float
    right_s: float


@contextmanager
def open_cameras(devices: Iterable[str], settings: CaptureSettings) -> Iterator[tuple[Camera, ...]]:
    """Open the left and the right camera, or one with both views, for the body of a ``with``.

    Args:
        devices: Numbers, paths, addresses of streams, or video files.
        settings: Image size and frame rate to ask for.
    """
    width, height = settings.width_px, settings.height_px
    size = None if width is None or height is None else (width, height)
    with ExitStack() as stack:
        cameras: list[Camera] = []
        for device in devices:
            cameras.append(OpenCvCamera(device, size, settings.rate_hz))
            stack.callback(cameras[-1].close)
        yield tuple(cameras)


def capture_pairs(
    cameras: tuple[Camera, ...], settings: RecordingSettings, stopped: Callable[[], bool]
) -> Iterator[CapturedPair]:
    """Yield pairs until the limit is reached, a file ends, or ``stopped`` returns True.

    If one camera loses a frame, the other drops its frame too, so that pairs are nearest in time.
    """
    period_s = 1 / _rate_hz(cameras, settings)
    first_s: float | None = None
    count = 0
    while not stopped() and count != settings.frames:
        stamps = _grab(cameras, period_s)
        if stamps is None:
            return
        first_s = stamps[0] if first_s is None else first_s
        if settings.seconds is not None and stamps[0] - first_s > settings.seconds:
            return
        left, right = _retrieve(cameras, settings)
        yield CapturedPair(left, right, stamps[0], stamps[-1])
        count += 1


def warm_up(cameras: tuple[Camera, ...], settings: CaptureSettings) -> bool:
    """Drop the first frames, then lock the exposure of the left camera on both.

    Video files need no warm-up and keep all their frames.

    Returns:
        Whether the exposure is locked on every camera.
    """
    if not all(camera.live for camera in cameras):
        return False
    for _ in range(_WARM_UP_FRAMES):
        for camera in cameras:
            camera.grab()
    if not settings.lock_exposure:
        return False
    exposure = cameras[0].lock(None)
    return exposure is not None and all(camera.lock(exposure) is not None for camera in cameras[1:])


def _rate_hz(cameras: tuple[Camera, ...], settings: CaptureSettings) -> float:
    known_hz = [camera.rate_hz for camera in cameras if np.isfinite(camera.rate_hz)]
    return settings.rate_hz or min(known_hz, default=_USUAL_RATE_HZ)


def _grab(cameras: tuple[Camera, ...], period_s: float) -> list[float] | None:
    """Grab frames taken together and return their timestamps; None at the end of a file."""
    stamps = [camera.grab() for camera in cameras]
    while all(stamp is not None for stamp in stamps):
        times = [stamp for stamp in stamps if stamp is not None]
        if max(times) - min(times) <= period_s / 2:
            return times
        earlier = int(np.argmin(times))
        stamps[earlier] = cameras[earlier].grab()
    silent = cameras[stamps.index(None)]
    if silent.live:
        raise SourceError(
            "camera gives no more frames", where=silent.name, hint="check its cable and power"
        )
    return None


def _retrieve(cameras: tuple[Camera, ...], settings: CaptureSettings) -> tuple[UInt8, UInt8]:
    images = [camera.retrieve() for camera in cameras]
    if len(images) == 1:
        _check_halves(images[0], cameras[0].name, settings)
        return split_views(images[0], SourceSettings(side_by_side=settings.side_by_side))
    if images[0].shape != images[1].shape:
        sizes = [f"{image.shape[1]}x{image.shape[0]}" for image in images]
        raise SourceError(
            "cameras differ in frame size",
            where=cameras[1].name,
            got=f"left {sizes[0]}, right {sizes[1]}",
            hint="request the same size from both with --size",
        )
    return images[0], images[1]


def _check_halves(image: UInt8, name: str, settings: CaptureSettings) -> None:
    stacked = settings.side_by_side in {"top-bottom", "bottom-top"}
    if image.shape[0 if stacked else 1] % 2:
        raise SourceError(
            "frames cannot be halved", where=name, got=f"{image.shape[1]}x{image.shape[0]}"
        )
