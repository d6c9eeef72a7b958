"""How many corners the board in a picture really has, whatever was claimed."""

from __future__ import annotations

from collections import Counter
from collections.abc import Sequence
from typing import Final

import cv2
import numpy as np

from recon.adapters.opencv_boards import dictionary_names, find_markers, marker_count
from recon.calibration.bundle import Sighting
from recon.calibration.detect import find_chessboard, refine_corners
from recon.errors import CalibrationError
from recon.structures.arrays import Float64, UInt8
from recon.structures.board import CalibrationBoard

Inner = tuple[int, int]

# An inner corner has dark and light quarters crosswise; beyond the pattern this contrast is gone.
_CORNER_CONTRAST: Final = 0.5
_LARGEST: Final = 60
# Pictures that are asked for the true size when the claimed one is found in none.
_PROBED: Final = 8
# … and for the markers of all of OpenCV's dictionaries, of which there are twenty.
_PROBED_MARKERS: Final = 2


def check_chessboard(
    pictures: Sequence[UInt8], seen: Sequence[Sighting | None], board: CalibrationBoard
) -> None:
    """Make sure that the board in the pictures has as many corners as was claimed.

    A part of a larger board is found without complaint, but not the same part in both pictures.

    Args:
        pictures: uint8 (H, W) each.
        seen: What was found in each.
        board: The board that was claimed.

    Raises:
        CalibrationError: Most pictures show another board; its size is told.
    """
    sizes = [
        grown_size(picture, sighting.pixels, board.inner)
        for picture, sighting in zip(pictures, seen, strict=True)
        if sighting is not None
    ]
    if 2 * len(sizes) < len(pictures):
        # What little was found may be a part of another board.
        empty = [p for p, sighting in zip(pictures, seen, strict=True) if sighting is None]
        sizes += [size for size in map(probe_size, spread(empty, _PROBED)) if size is not None]
    counts = Counter(tuple(sorted(size)) for size in sizes)
    if not counts:
        return
    size, votes = counts.most_common(1)[0]
    if size != tuple(sorted(board.inner)) and 2 * votes > len(sizes):
        raise _wrong_size(size, f"{votes} of {len(sizes)} pictures", board)


def check_charuco(pictures: Sequence[UInt8], board: CalibrationBoard) -> None:
    """Say what is wrong where a ChArUco board is found in no picture.

    Raises:
        CalibrationError: The markers are of another dictionary, or of a larger board.
    """
    probed = spread(pictures, _PROBED_MARKERS)
    votes = Counter({name: _marker_votes(probed, name) for name in dictionary_names()})
    best, most = votes.most_common(1)[0]
    if most and votes[board.dictionary] < most / 2:
        raise CalibrationError(
            "markers of the board are of another dictionary",
            got=best.lower(),
            expected=board.dictionary.lower(),
            hint=f"try --board {board.kind}:{board.columns}x{board.rows}:…:{best.lower()}",
        )
    numbers = np.concatenate([find_markers(p, board.dictionary) for p in probed])
    if numbers.size:
        raise CalibrationError(
            "markers are seen, but they do not stand as on this board",
            got=f"markers up to number {numbers.max()}",
            expected=f"0 to {marker_count(board) - 1} for {board.columns}x{board.rows} squares",
            hint="count squares, not corners; columns come first",
        )


def grown_size(grey: UInt8, pixels: Float64, inner: Inner) -> Inner:
    """Columns and rows of inner corners when a grid is continued for as long as there are corners.

    Args:
        grey: uint8 (H, W).
        pixels: float64 (N, 2), corners row by row.
        inner: Its columns and rows.
    """
    columns, rows = inner
    grid = pixels.reshape(rows, columns, 2)
    usual = float(np.nanmedian(_contrast(grey, grid)))
    for axis in (0, 1, 0, 1):
        for _ in range(_LARGEST):
            longer = _continue(grey, grid, axis, usual)
            if longer is None:
                grid = np.flip(grid, axis)
                longer = _continue(grey, grid, axis, usual)
            if longer is None:
                break
            grid = longer
    return grid.shape[1], grid.shape[0]


def probe_size(grey: UInt8) -> Inner | None:
    """Columns and rows of any chessboard in a picture, or None."""
    found, corners, meta = cv2.findChessboardCornersSBWithMeta(
        grey, (3, 3), cv2.CALIB_CB_LARGER | cv2.CALIB_CB_NORMALIZE_IMAGE | cv2.CALIB_CB_EXHAUSTIVE
    )
    if not found or meta is None:
        return None
    rows, columns = meta.shape[:2]
    pixels = np.asarray(corners, dtype=np.float64).reshape(-1, 2)
    if len(pixels) != rows * columns:
        return None
    size = grown_size(grey, pixels, (columns, rows))
    # What was grown must be found again as a whole: a texture of squares would not.
    return size if find_chessboard(grey, size) is not None else None


def spread(pictures: Sequence[UInt8], count: int) -> list[UInt8]:
    """At most so many pictures, evenly from first to last."""
    picked = np.unique(np.linspace(0, len(pictures) - 1, min(count, len(pictures))).astype(int))
    return [pictures[number] for number in picked]


def _continue(grey: UInt8, grid: Float64, axis: int, usual: float) -> Float64 | None:
    """The grid with one more line at the end of an axis, or None where no corners are there."""
    lines = np.moveaxis(grid, axis, 0)
    if len(lines) < 3 or len(lines) >= _LARGEST:
        return None
    # Perspective and lens bend a row: continue it by its curvature.
    guess = 3 * lines[-1] - 3 * lines[-2] + lines[-3]
    step = float(np.linalg.norm(guess - lines[-1], axis=1).min())
    height, width = grey.shape
    if step < 4 or (guess < 2).any() or (guess > (width - 3, height - 3)).any():
        return None
    longer = np.concatenate([lines, refine_corners(grey, guess, step)[None]])
    contrast = _contrast(grey, np.moveaxis(longer, 0, axis))
    added = np.moveaxis(contrast, axis, 0)[-1]
    if np.isnan(added).all() or not np.nanmedian(added) > _CORNER_CONTRAST * usual:
        return None
    return np.moveaxis(longer, 0, axis)


def _contrast(grey: UInt8, grid: Float64) -> Float64:
    """float64 (R, C), how much lighter one diagonal's quarters are than the other's, each alike.

    NaN where a quarter lies outside the picture.
    """
    down, across = np.gradient(grid, axis=(0, 1))
    quarters = [
        grid + 0.4 * (a * across + b * down) for a, b in ((1, 1), (-1, -1), (1, -1), (-1, 1))
    ]
    smooth = cv2.blur(grey, (3, 3))
    a, b, c, d = (_sample(smooth, places) for places in quarters)
    return np.asarray(np.abs(a + b - c - d) - np.abs(a - b) - np.abs(c - d)) / 2


def _sample(grey: UInt8, places: Float64) -> Float64:
    at = np.rint(places).astype(int)
    height, width = grey.shape
    inside = ((at >= 0) & (at < (width, height))).all(axis=-1)
    x, y = np.where(inside, at[..., 0], 0), np.where(inside, at[..., 1], 0)
    return np.where(inside, grey[y, x].astype(np.float64), np.nan)


def _marker_votes(pictures: Sequence[UInt8], dictionary: str) -> int:
    return sum(len(find_markers(picture, dictionary)) for picture in pictures)


def _wrong_size(size: tuple[int, ...], where: str, board: CalibrationBoard) -> CalibrationError:
    columns, rows = size if board.columns <= board.rows else size[::-1]
    claimed = f"{board.columns}x{board.rows}"
    squares = (columns + 1, rows + 1) == (board.columns, board.rows)
    why = "count inner corners, not squares" if squares else "count the inner corners again"
    return CalibrationError(
        f"the board in the pictures does not have {claimed} inner corners",
        got=f"{columns}x{rows} in {where}",
        expected=claimed,
        hint=f"{why}, or give --board chess:{columns}x{rows}:…",
    )
