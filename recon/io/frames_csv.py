"""``frames.csv``: the image pairs of a recording with their times, one line per pair.

A line is written after both of its images, so a pair is complete once its line exists.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Final

from recon.core.decimals import parse_number
from recon.core.errors import FormatError
from recon.io.files import StrPath, read_text, reader

FRAMES: Final = "frames.csv"
HEADER: Final = "# left image, right image, left time [s], right time [s]\n"


@dataclass(frozen=True)
class CapturedFrame:
    """One line: a pair of images and their times.

    Attributes:
        left: Left image, relative to the folder of the list.
        right: Right image, likewise.
        left_s: Time of the left image.
        right_s: Time of the right image.
    """

    left: str
    right: str
    left_s: float
    right_s: float

    def line(self) -> str:
        """Return this frame as a line, with the newline."""
        return f"{self.left},{self.right},{self.left_s:.6f},{self.right_s:.6f}\n"


@reader
def read_frames(path: StrPath) -> list[CapturedFrame]:
    """Read the list."""
    lines = enumerate(read_text(path).splitlines(), start=1)
    frames = [_parse(line, f"{path}:{n}") for n, line in lines if line and line[0] != "#"]
    if not frames:
        raise FormatError("file lists no images", where=path)
    return frames


def _parse(line: str, where: str) -> CapturedFrame:
    words = [word.strip() for word in line.split(",")]
    try:
        left, right, left_s, right_s = words
        times = parse_number(left_s), parse_number(right_s)
    except ValueError as error:
        raise FormatError("not two images and their times", where=where, got=line[:60]) from error
    if not all(math.isfinite(time) for time in times):
        raise FormatError("time is not finite", where=where, got=line[:60])
    return CapturedFrame(left, right, *times)
