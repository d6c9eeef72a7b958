"""Calibration boards: planar patterns whose corner positions are known."""

from __future__ import annotations

import re
from dataclasses import dataclass
from typing import Final, Literal

import numpy as np

from recon.core.errors import SettingsError
from recon.core.values.arrays import Float64

BoardKind = Literal["chess", "charuco"]

_FORMS: Final = (
    "chess:COLUMNSxROWS:SQUARE (inner corners, such as chess:9x6:25mm) or "
    "charuco:COLUMNSxROWS:SQUARE[:MARKER[:DICTIONARY]] "
    "(squares, such as charuco:8x6:30mm:22mm:5x5_100)"
)
_UNITS_M: Final = {"mm": 1e-3, "cm": 1e-2, "m": 1.0, "in": 0.0254, "": 1.0}
_LENGTH: Final = re.compile(r"(\d+(?:\.\d*)?|\.\d+)\s*(mm|cm|m|in|)", re.IGNORECASE | re.ASCII)
_SIZE: Final = re.compile(r"(\d+)\s*[x×]\s*(\d+)", re.IGNORECASE | re.ASCII)
_DICTIONARY: Final = re.compile(r"(?:DICT_)?(\w+)", re.IGNORECASE)
_LARGEST_SQUARE_M: Final = 5.0
_DEFAULT_MARKER: Final = 0.75  # of a square
_DEFAULT_DICTIONARY: Final = "5X5_100"


@dataclass(frozen=True)
class CalibrationBoard:
    """A chessboard, or a ChArUco board (chessboard with ArUco markers in its white squares)."""

    kind: BoardKind  # ``chess`` or ``charuco``
    columns: int  # number along x of inner corners (chessboard) or squares (ChArUco)
    rows: int  # the same along y
    square_m: float  # side length of a square
    marker_m: float = 0.0  # side length of a marker; 0 for a chessboard
    # OpenCV's name of the ArUco dictionary without ``DICT_``; "" for a chessboard
    dictionary: str = ""
    metric: bool = True  # whether the square size is known; if not, ``square_m`` is 1
    # whether a ChArUco board has the layout that OpenCV used before 4.6: with an even number of
    # rows, its first square is white
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
        if self.kind == "charuco" and not 0 < self.marker_m < self.square_m:
            raise SettingsError(
                "markers must be smaller than squares",
                got=f"marker {self.marker_m * 1e3:g} mm, square {self.square_m * 1e3:g} mm",
            )

    @property
    def inner(self) -> tuple[int, int]:
        """Number of inner corners along x and y."""
        less = 1 if self.kind == "charuco" else 0
        return self.columns - less, self.rows - less

    @property
    def squares(self) -> tuple[int, int]:
        return self.inner[0] + 1, self.inner[1] + 1

    @property
    def size_m(self) -> tuple[float, float]:
        """Width and height of the pattern, without margin."""
        return self.squares[0] * self.square_m, self.squares[1] * self.square_m

    @property
    def corners_m(self) -> Float64:
        """float64 (N, 3), the inner corners row by row; z = 0, the first corner is the origin."""
        columns, rows = self.inner
        y, x = np.mgrid[0:rows, 0:columns]
        flat = np.stack([x.ravel(), y.ravel(), np.zeros(x.size)], axis=1)
        return np.asarray(flat * self.square_m)

    def __str__(self) -> str:
        square = f"{self.square_m * 1e3:g}mm" if self.metric else "?"
        text = f"{self.kind}:{self.columns}x{self.rows}:{square}"
        marked = f":{self.marker_m * 1e3:g}mm:{self.dictionary.lower()}"
        older = ":legacy" if self.legacy else ""
        return text + (marked + older if self.kind == "charuco" else "")


def parse_board(text: str) -> CalibrationBoard:
    """Parse the text form of a board; lengths are in mm, cm, m or in, bare numbers in metres.

    ``chess:9x6:25mm`` has 9 by 6 inner corners and squares of 25 mm;
    ``charuco:8x6:30mm:22mm:5x5_100`` has 8 by 6 squares and 22 mm markers of that dictionary
    (defaults: three quarters of a square, 5x5_100); ``:legacy`` is OpenCV's layout before 4.6.
    """
    kind, *parts = [part.strip() for part in text.strip().split(":")]
    if kind.lower() not in ("chess", "charuco") or not parts:
        raise _unreadable(text)
    size = _SIZE.fullmatch(parts[0])
    legacy = kind.lower() == "charuco" and len(parts) == 5 and parts[4].lower() == "legacy"
    most = 2 if kind.lower() == "chess" else 4 + legacy
    if size is None or len(parts) > most:
        raise _unreadable(text)
    columns, rows = int(size[1]), int(size[2])
    square_m = _length_m(parts[1], text) if len(parts) > 1 else 1.0
    if kind.lower() == "chess":
        return CalibrationBoard("chess", columns, rows, square_m, metric=len(parts) > 1)
    marker_m = _length_m(parts[2], text) if len(parts) > 2 else square_m * _DEFAULT_MARKER
    dictionary = _DICTIONARY.fullmatch(parts[3]) if len(parts) > 3 else None
    name = dictionary[1].upper() if dictionary else _DEFAULT_DICTIONARY
    sized = len(parts) > 1
    return CalibrationBoard("charuco", columns, rows, square_m, marker_m, name, sized, legacy)


def _length_m(text: str, whole: str) -> float:
    found = _LENGTH.fullmatch(text)
    if found is None:
        raise _unreadable(whole)
    return float(found[1]) * _UNITS_M[found[2].lower()]


def _unreadable(text: str) -> SettingsError:
    return SettingsError("cannot read this board", where="--board", got=repr(text), expected=_FORMS)
