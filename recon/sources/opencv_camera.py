"""Live cameras through OpenCV; a video file can take the place of a camera."""

from __future__ import annotations

import time
from pathlib import Path
from typing import Final

import cv2
import numpy as np

from recon.core.errors import SourceError
from recon.core.text import is_count
from recon.core.values.arrays import UInt8
from recon.io.images.image import silent_opencv

_LONGEST_NUMBER: Final = 10
_HEAD_BYTES: Final = 4096
# V4L2's exposure modes: 1 = manual, 3 = automatic.
_MANUAL: Final = 1


class Camera:
    """A device (``0``, ``/dev/video0``), asked for size and rate, or a video file, not ``live``."""

    def __init__(
        self, device: str, size: tuple[int, int] | None = None, rate_hz: float | None = None
    ) -> None:
        self.name, self.live = device, not Path(device).is_file()
        number = int(device) if is_count(device) and len(device) < _LONGEST_NUMBER else None
        if Path(device).is_fifo() or Path(device).is_socket():  # opening one would wait for ever
            raise SourceError("not a camera and not a regular file", where=device)
        if not self.live and _is_text(Path(device)):  # which OpenCV draws, letter by letter
            raise SourceError("not a video", where=device, got="a text file")
        with silent_opencv():
            self._capture = cv2.VideoCapture(device if number is None else number)
        if not self._capture.isOpened():
            found = ", ".join(sorted(str(path) for path in Path("/dev").glob("video*")))
            expected = f"one of {found}" if found else "a camera: there is no /dev/video*"
            hint = "another program may be using it"
            raise SourceError("camera cannot be opened", where=device, expected=expected, hint=hint)
        if self.live:
            self._ask(size, rate_hz)

    @property
    def rate_hz(self) -> float:
        """Frames per second; NaN if the driver does not report it."""
        rate = self._capture.get(cv2.CAP_PROP_FPS)
        return float(rate) if rate > 0 else float("nan")

    def grab(self) -> float | None:
        """Grab the next frame without decoding it; returns its time in seconds, None = the end."""
        if not self._capture.grab():
            return None
        now_s = time.monotonic()
        stamp_s = self._capture.get(cv2.CAP_PROP_POS_MSEC) / 1000
        # A driver without timestamps returns 0, or uses another clock.
        believed = not self.live or 0 <= now_s - stamp_s < 1
        return float(stamp_s) if believed else now_s

    def retrieve(self) -> UInt8:
        """Decode the grabbed frame: uint8 (H, W, 3) RGB."""
        done, image = self._capture.retrieve()
        if not done:
            raise SourceError("frame cannot be decoded", where=self.name)
        return np.asarray(cv2.cvtColor(image, cv2.COLOR_BGR2RGB), dtype=np.uint8)

    def lock(self, exposure: float | None) -> float | None:
        """Fix white balance and exposure (None = the current); returns it, None = not supported."""
        if not self.live:
            return None
        value = self._capture.get(cv2.CAP_PROP_EXPOSURE) if exposure is None else exposure
        self._capture.set(cv2.CAP_PROP_AUTO_WB, 0)
        held = self._capture.set(cv2.CAP_PROP_AUTO_EXPOSURE, _MANUAL) and self._capture.set(
            cv2.CAP_PROP_EXPOSURE, value
        )
        return float(value) if held else None

    def close(self) -> None:
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
            what, got = "camera does not support this image size", f"{given[0]}x{given[1]}"
            raise SourceError(what, where=self.name, got=got, expected=f"{size[0]}x{size[1]}")


def _is_text(path: Path) -> bool:
    """Return whether a file begins with printable text, as no video does."""
    with path.open("rb") as file:
        head = file.read(_HEAD_BYTES).decode("latin-1")
    return bool(head) and all(letter.isprintable() or letter.isspace() for letter in head)
