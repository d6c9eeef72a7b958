"""Recording from two cameras, or from one that gives both views side by side.

Both are grabbed before either is decoded, so that decoding does not come between them. What is
recorded is the layout of plain folders (see `folders`); a pair counts when its line in
``frames.csv`` stands, and that is written last.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator
from dataclasses import dataclass
from typing import Final, Literal

import numpy as np
from pydantic import Field

from recon.adapters.opencv_camera import Camera
from recon.errors import SourceError
from recon.settings import Settings
from recon.sources.settings import SourceSettings
from recon.sources.video import split_views
from recon.structures.arrays import UInt8

# A driver that does not tell its rate: most cameras have this one.
_USUAL_RATE_HZ: Final = 30.0


class CaptureSettings(Settings):
    """What is recorded."""

    width_px: int | None = Field(
        default=None, ge=16, description="Frame width to ask the driver for. none = as it is."
    )
    height_px: int | None = Field(default=None, ge=16, description="Frame height to ask for.")
    rate_hz: float | None = Field(default=None, gt=0, description="Frames per second to ask for.")
    frames: int | None = Field(default=None, ge=1, description="Stop after so many pairs.")
    seconds: float | None = Field(default=None, gt=0, description="Stop after so long.")
    warm_up: int = Field(
        default=15, ge=0, description="Frames dropped first, while a camera finds its exposure."
    )
    lock_exposure: bool = Field(
        default=True, description="Hold exposure and white balance where the driver can."
    )
    side_by_side: Literal["left-right", "right-left", "top-bottom", "bottom-top"] = Field(
        default="left-right", description="Where the views are in the frames of a single device."
    )
    suffix: Literal["png", "jpg"] = Field(
        default="png", description="Png = lossless; jpg where the disk is too slow."
    )
    preview_every: int | None = Field(
        default=None, ge=1, description="Every n-th pair also replaces preview.jpg. none = none."
    )


@dataclass(frozen=True, eq=False)
class CapturedPair:
    """One pair as it comes from the cameras.

    Attributes:
        left: uint8 (H, W, 3) RGB.
        right: The same of the right one.
        left_s: When the left one was taken.
        right_s: When the right one was taken.
    """

    left: UInt8
    right: UInt8
    left_s: float
    right_s: float


def capture_pairs(
    cameras: tuple[Camera, ...], settings: CaptureSettings, stopped: Callable[[], bool]
) -> Iterator[CapturedPair]:
    """Yield pairs until enough are there, a file ends, or it is told to stop.

    Where one camera has lost a frame, the other drops one too: pairs are the nearest in time.

    Args:
        cameras: Left and right, or one with both views.
        settings: When to stop.
        stopped: Asked before every pair.

    Raises:
        SourceError: A live camera gives no more frames, or the two differ in size.
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
    """Drop the first frames, then hold the exposure: the left one's on both sides.

    Files need no warming up, and keep all their frames.

    Returns:
        Whether every driver holds it.
    """
    if not all(camera.live for camera in cameras):
        return False
    for _ in range(settings.warm_up):
        for camera in cameras:
            camera.grab()
    if not settings.lock_exposure:
        return False
    exposure = cameras[0].lock(None)
    return exposure is not None and all(camera.lock(exposure) is not None for camera in cameras[1:])


def _rate_hz(cameras: tuple[Camera, ...], settings: CaptureSettings) -> float:
    told = [camera.rate_hz for camera in cameras if np.isfinite(camera.rate_hz)]
    return settings.rate_hz or min(told, default=_USUAL_RATE_HZ)


def _grab(cameras: tuple[Camera, ...], period_s: float) -> list[float] | None:
    """Stamps of frames that were taken together; None where a file ends."""
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
            "camera gives no more frames", where=silent.name, hint="check its cable and its power"
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
            "cameras differ in size",
            where=cameras[1].name,
            got=f"left {sizes[0]}, right {sizes[1]}",
            hint="ask both for one size with --size",
        )
    return images[0], images[1]


def _check_halves(image: UInt8, name: str, settings: CaptureSettings) -> None:
    stacked = settings.side_by_side in {"top-bottom", "bottom-top"}
    if image.shape[0 if stacked else 1] % 2:
        raise SourceError(
            "frames cannot be halved", where=name, got=f"{image.shape[1]}x{image.shape[0]}"
        )
