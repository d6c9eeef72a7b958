"""How many corners the board in a picture really has, whatever was claimed."""

from __future__ import annotations

from collections import Counter
from collections.abc import Callable, Sequence
from typing import Final

import cv2
import numpy as np

from recon.adapters.opencv_boards import dictionary_names, find_markers, marker_count
from recon.calibration.detect import find_chessboard, refine_corners
from recon.errors import CalibrationError
from recon.structures.arrays import Float64, UInt8
from recon.structures.board import CalibrationBoard

Inner = tuple[int, int]

# An inner corner has dark and light quarters crosswise; beyond the pattern this contrast is gone.
_CORNER_CONTRAST: Final = 0.5
_LARGEST: Final = 60
# So many pictures that agree on a size, or markers in a picture, are no accident.
_SURE: Final = 3
# Pictures that are asked for the true size when the claimed one is found in few.
_PROBED: Final = 8
# … and for the markers of all of OpenCV's dictionaries, of which there are twenty.
_PROBED_MARKERS: Final = 2


def check_chessboard(
    sizes: Sequence[Inner | None], read: Callable[[int], UInt8], board: CalibrationBoard
) -> None:
    """Make sure that the board in the pictures has as many corners as was claimed.

    A part of a larger board is found without complaint, but not the same part in both pictures.

    Args:
        sizes: `grown_size` of what was found in each picture, None where nothing was.
        read: Gives a picture, uint8 (H, W), by its number.
        board: The board that was claimed.

    Raises:
        CalibrationError: Most pictures show another board; its size is told.
    """
    claimed = _sorted(board.inner)
    seen = Counter(_sorted(size) for size in sizes if size is not None)
    if not seen:
        _check_no_markers([read(n) for n in _spread(range(len(sizes)), _PROBED_MARKERS)], board)
    probed: list[Inner | None] = []
    if 2 * seen.total() < len(sizes):
        # What little was found may be a part of another board.
        empty = [number for number, size in enumerate(sizes) if size is None]
        probed = [probe_size(read(number)) for number in _spread(empty, _PROBED)]
    others = Counter(_sorted(size) for size in probed if size is not None)
    for votes, voters, enough in (
        (others, len(probed), _SURE),
        (seen + others, (seen + others).total(), (seen + others).total() // 2 + 1),
    ):
        size, most = next(iter(votes.most_common(1)), (claimed, 0))
        larger = any(n > m for n, m in zip(size, claimed, strict=True))
        # Where the claimed board was seen whole, a smaller one is a part of it.
        if most >= enough and size != claimed and (larger or not seen[claimed]):
            raise _wrong_size(size, f"{most} of {voters} pictures", board)


def check_charuco(count: int, read: Callable[[int], UInt8], board: CalibrationBoard) -> None:
    """Say what is wrong where a ChArUco board is found in no picture.

    Args:
        count: Number of pictures.
        read: Gives a picture, uint8 (H, W), by its number.
        board: The board that was claimed.

    Raises:
        CalibrationError: The markers are of another dictionary, or of a larger board, or there
            are none but a plain chessboard.
    """
    probed = [read(number) for number in _spread(range(count), _PROBED_MARKERS)]
    best, votes = _marker_votes(probed)
    if votes[best] and votes[board.dictionary] < votes[best] / 2:
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
    plain = [size for size in map(probe_size, probed) if size is not None]
    if plain:
        columns, rows = max(plain, key=lambda size: size[0] * size[1])
        raise CalibrationError(
            "the pictures show a chessboard without markers",
            got=f"{columns}x{rows} inner corners",
            expected=str(board),
            hint=f"try --board chess:{columns}x{rows}:…",
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


def _spread(numbers: Sequence[int], count: int) -> list[int]:
    """At most so many of the numbers, evenly from first to last."""
    at = np.unique(np.linspace(0, len(numbers) - 1, min(count, len(numbers))).astype(int))
    return [numbers[place] for place in at]


def _sorted(size: Inner) -> Inner:
    """A board may be held upright or across."""
    return min(size), max(size)


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


def _marker_votes(pictures: Sequence[UInt8]) -> tuple[str, Counter[str]]:
    """The dictionary of which most markers are seen, and how many of each."""
    votes = Counter(
        {
            name: sum(len(find_markers(picture, name)) for picture in pictures)
            for name in dictionary_names()
        }
    )
    return votes.most_common(1)[0][0], votes


def _check_no_markers(pictures: Sequence[UInt8], board: CalibrationBoard) -> None:
    best, votes = _marker_votes(pictures)
    if votes[best] >= _SURE * len(pictures):
        raise CalibrationError(
            "the pictures show a board with markers (ChArUco)",
            got=f"markers of {best.lower()}",
            expected=str(board),
            hint=f"try --board charuco:COLUMNSxROWS:SQUARE:MARKER:{best.lower()}, in squares",
        )


def _wrong_size(size: Inner, where: str, board: CalibrationBoard) -> CalibrationError:
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
