"""Calibration boards: planar patterns whose corner positions are known."""

from __future__ import annotations

import re
from dataclasses import dataclass
from typing import Final, Literal, cast

import numpy as np

from recon.core.errors import SettingsError
from recon.core.values.arrays import Float64

BoardKind = Literal["chess", "charuco", "aprilgrid", "circles", "acircles"]


@dataclass(frozen=True)
class _Kind:
    """What is known of a kind of board: how it is written, and where its corners are."""

    form: str  # an example, and what is in it
    less: int  # by how much corners are fewer than columns and rows
    each: int  # corners along one side of a column
    said: str  # what the given length is of
    most: int = 1  # lengths and words after the size
    usual: float = 0.0  # the second length, relative to the first
    dictionary: str = ""
    numbered: bool = False  # whether its corners cannot be taken for one another
    other: str = ""  # name of its other layout


_KINDS: Final[dict[str, _Kind]] = {
    "chess": _Kind(
        "chess:9x6:25mm (inner corners, square)", 0, 1, "squares"
    ),
    "charuco": _Kind(
        "charuco:8x6:30mm:22mm:5x5_100 (squares, square, marker)",
        1, 1, "squares", 3, 0.75, "5X5_100", True, "legacy",
    ),
    "aprilgrid": _Kind(
        "aprilgrid:6x6:88mm:0.3 (tags, tag, gap relative to it)",
        0, 2, "tags", 2, 0.3, "APRILTAG_36H11", True, "thin",
    ),
    "circles": _Kind(
        "circles:7x6:20mm:10mm (circles, step, diameter)",
        0, 1, "steps", 2, 0.4,
    ),
    "acircles": _Kind(
        "acircles:4x11:20mm:16mm (every other row a step to the right)",
        0, 1, "steps", 2, 0.4,
    ),
}  # fmt: skip
_FORMS: Final = ", ".join(kind.form for kind in _KINDS.values()) + ", or a target.yaml of kalibr"
_UNITS_M: Final = {"mm": 1e-3, "cm": 1e-2, "m": 1.0, "in": 0.0254, "": 1.0}
_LENGTH: Final = re.compile(r"(\d+(?:\.\d*)?|\.\d+)\s*(mm|cm|m|in|)", re.IGNORECASE | re.ASCII)
_SIZE: Final = re.compile(r"(\d+)\s*[x×]\s*(\d+)", re.IGNORECASE | re.ASCII)
_DICTIONARY: Final = re.compile(r"(?:DICT_)?(\w+)", re.IGNORECASE)
_LARGEST_SQUARE_M: Final = 5.0


@dataclass(frozen=True)
class CalibrationBoard:
    """A chessboard, one with ArUco markers in its white squares (ChArUco), AprilTags, or circles.

    AprilTags lie as kalibr draws them: numbered from the lower left, with black squares between
    their corners. In ``acircles``, every other row is one step to the right.
    """

    kind: BoardKind
    columns: int  # number along x of inner corners (chessboard), squares (ChArUco), tags or circles
    rows: int  # the same along y
    square_m: float  # side length of a square; step from tag to tag, or of the grid of circles
    marker_m: float = 0.0  # side length of a marker or tag, diameter of a circle; 0 = chessboard
    # OpenCV's name of the ArUco dictionary without ``DICT_``; "" where there are no markers
    dictionary: str = ""
    metric: bool = True  # whether the square size is known; if not, ``square_m`` is 1
    # whether it has the other layout: of ChArUco that of OpenCV before 4.6 (with an even number of
    # rows, its first square is white), of AprilTags a border of one bit, not two
    legacy: bool = False

    def __post_init__(self) -> None:
        if min(self.inner) < 2:
            got = f"{self.inner[0]}x{self.inner[1]}"
            raise SettingsError("board has too few inner corners", got=got, expected="2x2 or more")
        if not 0 < self.square_m <= _LARGEST_SQUARE_M:
            raise SettingsError(
                "square size of the board is implausible",
                got=f"{self.square_m:g} m",
                expected=f"above 0, at most {_LARGEST_SQUARE_M:g} m",
                hint="give the unit: 25mm, 2.5cm, 1in",
            )
        # Circles of every other row are nearer than those of a row are: by the root of two.
        step_m = self.square_m * (2**0.5 if self.kind == "acircles" else 1.0)
        if self.kind != "chess" and not 0 < self.marker_m < step_m:
            raise SettingsError(
                "markers must be smaller than squares, and circles than the step between them",
                got=f"marker {self.marker_m * 1e3:g} mm, square {self.square_m * 1e3:g} mm",
            )

    @property
    def inner(self) -> tuple[int, int]:
        """Number of corners along x and y: inner ones, those of tags, or centres of circles."""
        kind = _KINDS[self.kind]
        return self.columns * kind.each - kind.less, self.rows * kind.each - kind.less

    @property
    def numbered(self) -> bool:
        """Whether each corner is told from all others; else the board can be turned."""
        return _KINDS[self.kind].numbered or (self.kind == "acircles" and self.rows % 2 == 1)

    @property
    def squares(self) -> tuple[int, int]:
        return self.inner[0] + 1, self.inner[1] + 1

    @property
    def margin_m(self) -> float:
        """How far the pattern goes on beyond its outermost corners."""
        gap_m = self.square_m - self.marker_m
        own = {"aprilgrid": gap_m, "circles": self.marker_m / 2, "acircles": self.marker_m / 2}
        return own.get(self.kind, self.square_m)

    @property
    def size_m(self) -> tuple[float, float]:
        """Width and height of the pattern, without margin."""
        width_m, height_m = np.ptp(self.corners_m[:, :2], axis=0) + 2 * self.margin_m
        return float(width_m), float(height_m)

    @property
    def corners_m(self) -> Float64:
        """float64 (N, 3), the corners row by row; z = 0, the first corner is the origin.

        y goes down; the rows of tags go up, as kalibr numbers them.
        """
        columns, rows = self.inner
        row, column = np.mgrid[0:rows, 0:columns].astype(np.float64)
        if self.kind == "aprilgrid":
            inside = self.marker_m / self.square_m
            column, row = (n // 2 + n % 2 * inside for n in (column, row))
            row = -row
        elif self.kind == "acircles":
            column = 2 * column + row % 2
        flat = np.stack([column.ravel(), row.ravel(), np.zeros(row.size)], axis=1)
        return np.asarray(flat * self.square_m)

    @property
    def measured(self) -> tuple[str, float]:
        """What the length in its text is of, and that length in metres."""
        given_m = self.marker_m if self.kind == "aprilgrid" else self.square_m
        return _KINDS[self.kind].said, given_m

    def __str__(self) -> str:
        parts = [self.kind, f"{self.columns}x{self.rows}"]
        parts.append(f"{self.measured[1] * 1e3:g}mm" if self.metric else "?")
        if self.kind == "aprilgrid":
            parts.append(f"{self.square_m / self.marker_m - 1:g}")
        elif self.kind != "chess":
            parts.append(f"{self.marker_m * 1e3:g}mm")
        if self.kind == "charuco":
            parts.append(self.dictionary.lower())
        return ":".join([*parts, _KINDS[self.kind].other] if self.legacy else parts)


def parse_board(text: str) -> CalibrationBoard:
    """Parse the text form of a board; lengths are in mm, cm, m or in, bare numbers in metres.

    ``chess:9x6:25mm`` has 9 by 6 inner corners and squares of 25 mm;
    ``charuco:8x6:30mm:22mm:5x5_100`` has 8 by 6 squares and 22 mm markers of that dictionary
    (defaults: three quarters of a square, 5x5_100); ``:legacy`` is OpenCV's layout before 4.6.
    ``aprilgrid:6x6:88mm:0.3`` has 6 by 6 tags of 88 mm, and gaps of 0.3 tags; ``:thin`` has borders
    of one bit. ``circles:7x6:20mm:10mm`` has 7 by 6 circles of 10 mm, centres 20 mm apart.
    """
    name, *parts = [part.strip() for part in text.strip().split(":")]
    kind = _KINDS.get(name.lower())
    if kind is None or not parts:
        raise _unreadable(text)
    size, *own = parts
    legacy = bool(kind.other) and own[kind.most :] == [kind.other]
    found = _SIZE.fullmatch(size)
    if found is None or len(own) > kind.most + legacy:
        raise _unreadable(text)
    given_m = _length_m(own[0], text) if own else 1.0
    second = _length_m(own[1], text) if len(own) > 1 else None
    square_m, marker_m = given_m, kind.usual * given_m if second is None else second
    if name.lower() == "aprilgrid":
        square_m, marker_m = given_m * (1 + (kind.usual if second is None else second)), given_m
    word = _DICTIONARY.fullmatch(own[2]) if own[2 : kind.most] else None
    dictionary = word[1].upper() if word else kind.dictionary
    known = cast("BoardKind", name.lower())
    columns, rows = int(found[1]), int(found[2])
    return CalibrationBoard(known, columns, rows, square_m, marker_m, dictionary, bool(own), legacy)


def _length_m(text: str, whole: str) -> float:
    found = _LENGTH.fullmatch(text)
    if found is None:
        raise _unreadable(whole)
    return float(found[1]) * _UNITS_M[found[2].lower()]


def _unreadable(text: str) -> SettingsError:
    return SettingsError("cannot read this board", where="--board", got=repr(text), expected=_FORMS)
