"""Video files, decoded frame by frame with OpenCV's FFmpeg."""

from __future__ import annotations

import os
from collections.abc import Iterable, Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path
from typing import Final

import cv2

from recon.core.errors import FormatError
from recon.core.text import counted
from recon.core.values.arrays import UInt8
from recon.io.files import StrPath, reader
from recon.io.images.image import MAX_MEGAPIXELS, silent_opencv, swap_red_and_blue

VIDEOS: Final = frozenset(
    {".avi", ".m4v", ".mjpeg", ".mjpg", ".mkv", ".mov", ".mp4", ".mpeg", ".mpg", ".ts", ".webm"}
)
# A container may derive its number of frames from its duration, with rounding.
_COUNT_TOLERANCE: Final = 2


@dataclass(frozen=True)
class VideoFile:
    """A video file as its container and packets describe it; an orientation tag is ignored."""

    path: Path
    frames: int
    width_px: int
    height_px: int
    rate_hz: float

    @property
    def size_px(self) -> tuple[int, int]:
        return self.width_px, self.height_px

    def pick(self, numbers: Iterable[int]) -> Iterator[tuple[float, UInt8]]:
        """Yield frames of increasing numbers: seconds from the start, and uint8 (H, W, 3) RGB."""
        with _opened(self.path) as capture:
            after = 0
            for index in numbers:
                for each in range(after, index + 1):
                    if not capture.grab():
                        raise self._broken(each)
                after = index + 1
                stamp_s = capture.get(cv2.CAP_PROP_POS_MSEC) / 1000
                done, image = capture.retrieve()
                if not done:
                    raise self._broken(index)
                yield stamp_s, swap_red_and_blue(image)

    def _broken(self, index: int) -> FormatError:
        return FormatError(
            "video cannot be decoded to its end",
            where=self.path,
            got=counted(index, "frame"),
            expected=f"{self.frames}",
            hint="copy the file again, or cut it before the damage",
        )


@reader
def open_video(path: StrPath) -> VideoFile:
    """Open a video file and count its frames without decoding them."""
    file = Path(path)
    if not file.is_file():
        raise FormatError("file does not exist", where=file)
    with _opened(file) as capture:
        promised = capture.get(cv2.CAP_PROP_FRAME_COUNT)
        rate_hz = capture.get(cv2.CAP_PROP_FPS)
        size = [int(capture.get(p)) for p in (cv2.CAP_PROP_FRAME_WIDTH, cv2.CAP_PROP_FRAME_HEIGHT)]
        if size[0] * size[1] > MAX_MEGAPIXELS * 1e6:
            got, expected = f"{size[0]}x{size[1]}", f"at most {MAX_MEGAPIXELS:g} million"
            raise FormatError("video has too many pixels", where=file, got=got, expected=expected)
        if not capture.grab() or not rate_hz > 0:
            raise FormatError("video has no frame that can be decoded", where=file)
    frames = _count(file)
    if frames < promised - _COUNT_TOLERANCE:
        got, expected = counted(frames, "frame"), f"{promised:.0f}, as its header says"
        hint = f"copy the file again, or repair it: ffmpeg -i {file.name} -c copy whole.mkv"
        raise FormatError("video is truncated", where=file, got=got, expected=expected, hint=hint)
    return VideoFile(file, frames, size[0], size[1], rate_hz)


def _count(path: Path) -> int:
    with _opened(path) as capture:
        capture.set(cv2.CAP_PROP_FORMAT, -1)  # raw packets, not decoded
        count = 0
        while capture.grab():
            count += 1
    return count


@contextmanager
def _opened(path: Path) -> Iterator[cv2.VideoCapture]:
    # Stop FFmpeg from logging to standard error what we raise as an exception anyway.
    os.environ.setdefault("OPENCV_FFMPEG_LOGLEVEL", "-8")
    with silent_opencv():
        capture = cv2.VideoCapture(str(path), cv2.CAP_FFMPEG)
    try:
        if not capture.isOpened():
            hint = "it may be truncated or use an unknown codec; try: ffmpeg -i FILE copy.mkv"
            raise FormatError("not a readable video", where=path, hint=hint)
        capture.set(cv2.CAP_PROP_ORIENTATION_AUTO, 0)
        yield capture
    finally:
        capture.release()
