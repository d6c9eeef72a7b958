"""Live cameras through OpenCV. A video file stands in for one."""

from __future__ import annotations

import time
from pathlib import Path
from typing import Final, Protocol

import cv2
import numpy as np

from recon.errors import SourceError
from recon.structures.arrays import UInt8

# V4L2's menu of exposure modes: 1 = manual, 3 = automatic.
_MANUAL: Final = 1


class Camera(Protocol):
    """What a capture needs of a camera."""

    name: str
    live: bool

    @property
    def rate_hz(self) -> float:
        """Frames per second; NaN where the driver does not tell."""
        ...

    def grab(self) -> float | None:
        """Take the next frame without decoding it; its time in seconds, None = no more."""
        ...

    def retrieve(self) -> UInt8:
        """Decode the frame that was grabbed: uint8 (H, W, 3) RGB."""
        ...

    def lock(self, exposure: float | None) -> float | None:
        """Hold exposure and white balance; the exposure, None = the driver cannot."""
        ...

    def close(self) -> None:
        """Give the device back."""
        ...


class OpenCvCamera:
    """A device by number or path, or a video file.

    Args:
        device: ``0``, ``/dev/video0`` or a file.
        size: Width and height to ask for; None = as it is.
        rate_hz: Frames per second to ask for; None = as it is.

    Attributes:
        name: The device as given.
        live: False for a file.

    Raises:
        SourceError: The device cannot be opened, or cannot give that size.
    """

    def __init__(
        self, device: str, size: tuple[int, int] | None = None, rate_hz: float | None = None
    ) -> None:
        self.name, self.live = device, not Path(device).is_file()
        number = int(device) if device.isdigit() else None
        log = cv2.utils.logging
        before = log.getLogLevel()
        log.setLogLevel(log.LOG_LEVEL_SILENT)  # what it writes is raised as an error below
        try:
            self._capture = cv2.VideoCapture(device if number is None else number)
        finally:
            log.setLogLevel(before)
        if not self._capture.isOpened():
            found = ", ".join(sorted(str(path) for path in Path("/dev").glob("video*")))
            raise SourceError(
                "camera cannot be opened",
                where=device,
                expected=f"one of {found}" if found else "a camera: there is no /dev/video*",
                hint="another program may use it",
            )
        if self.live:
            self._ask(size, rate_hz)

    @property
    def rate_hz(self) -> float:
        """Frames per second; NaN where the driver does not tell."""
        rate = self._capture.get(cv2.CAP_PROP_FPS)
        return float(rate) if rate > 0 else float("nan")

    def grab(self) -> float | None:
        """Take the next frame without decoding it.

        Returns:
            When it was taken, as the driver says, in seconds of the machine's monotonic clock; of
            a file its position. None = there is no more.
        """
        if not self._capture.grab():
            return None
        now_s = time.monotonic()
        stamp_s = self._capture.get(cv2.CAP_PROP_POS_MSEC) / 1000
        # A driver without stamps says 0, or counts from somewhere else.
        believed = not self.live or 0 <= now_s - stamp_s < 1
        return float(stamp_s) if believed else now_s

    def retrieve(self) -> UInt8:
        """Decode the frame that was grabbed: uint8 (H, W, 3) RGB.

        Raises:
            SourceError: It cannot be decoded.
        """
        done, image = self._capture.retrieve()
        if not done:
            raise SourceError("frame cannot be decoded", where=self.name)
        return np.asarray(cv2.cvtColor(image, cv2.COLOR_BGR2RGB), dtype=np.uint8)

    def lock(self, exposure: float | None) -> float | None:
        """Hold exposure and white balance.

        Args:
            exposure: Of the other camera, in the driver's unit; None = as it is now.

        Returns:
            The exposure that is held; None = the driver cannot.
        """
        if not self.live:
            return None
        value = self._capture.get(cv2.CAP_PROP_EXPOSURE) if exposure is None else exposure
        self._capture.set(cv2.CAP_PROP_AUTO_WB, 0)
        held = self._capture.set(cv2.CAP_PROP_AUTO_EXPOSURE, _MANUAL) and self._capture.set(
            cv2.CAP_PROP_EXPOSURE, value
        )
        return float(value) if held else None

    def close(self) -> None:
        """Give the device back."""
        self._capture.release()

    def _ask(self, size: tuple[int, int] | None, rate_hz: float | None) -> None:
        if rate_hz is not None:
            self._capture.set(cv2.CAP_PROP_FPS, rate_hz)
        if size is None:
            return
        keys = (cv2.CAP_PROP_FRAME_WIDTH, cv2.CAP_PROP_FRAME_HEIGHT)
        for key, value in zip(keys, size, strict=True):
            self._capture.set(key, value)
        given = tuple(int(self._capture.get(key)) for key in keys)
        if given != size:
            raise SourceError(
                "camera cannot give this size",
                where=self.name,
                got=f"{given[0]}x{given[1]}",
                expected=f"{size[0]}x{size[1]}",
            )
