"""``frames.csv``: which pictures were taken together, and when; one line per pair.

A pair counts when its line stands: the line is written after both pictures.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Final

from recon.errors import FormatError
from recon.formats.files import StrPath, read_text

FRAMES: Final = "frames.csv"
HEADER: Final = "# left picture, right picture, left time [s], right time [s]\n"


@dataclass(frozen=True)
class CapturedFrame:
    """One line.

    Attributes:
        left: Left picture, relative to the folder of the list.
        right: Right picture.
        left_s: When the left one was taken.
        right_s: When the right one was taken.
    """

    left: str
    right: str
    left_s: float
    right_s: float

    def line(self) -> str:
        """The line of this frame, with its end."""
        return f"{self.left},{self.right},{self.left_s:.6f},{self.right_s:.6f}\n"


def read_frames(path: StrPath) -> list[CapturedFrame]:
    """Read the list.

    Raises:
        FormatError: It is missing or empty, or a line is damaged.
    """
    lines = enumerate(read_text(path).splitlines(), start=1)
    frames = [_parse(line, f"{path}:{n}") for n, line in lines if line and line[0] != "#"]
    if not frames:
        raise FormatError("file lists no pictures", where=path)
    return frames


def _parse(line: str, where: str) -> CapturedFrame:
    words = [word.strip() for word in line.split(",")]
    try:
        left, right, left_s, right_s = words
        times = float(left_s), float(right_s)
    except ValueError as error:
        raise FormatError("not two pictures and their times", where=where, got=line[:60]) from error
    if not all(math.isfinite(time) for time in times):
        raise FormatError("time is not finite", where=where, got=line[:60])
    return CapturedFrame(left, right, *times)
