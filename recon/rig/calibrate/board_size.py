"""Check the size of the board in the images against the size that the user gave."""

from __future__ import annotations

from collections import Counter
from collections.abc import Callable, Sequence
from typing import Final

import cv2
import numpy as np

from recon.core.errors import CalibrationError
from recon.core.values.arrays import Float64, UInt8
from recon.core.values.board import CalibrationBoard
from recon.core.words import counted
from recon.rig.calibrate.detect import find_chessboard, refine_corners
from recon.rig.opencv_boards import dictionary_names, find_markers, marker_count

Inner = tuple[int, int]

# Least contrast of dark and light quadrants at an inner corner, relative to the median corner.
_CORNER_CONTRAST: Final = 0.5
_LARGEST: Final = 60
# Images that must agree on a size, or markers per image, to rule out chance.
_SURE: Final = 3
# Images in which any board is searched if few show the given one.
_PROBED: Final = 8
# Fewer for markers, because all of OpenCV's twenty dictionaries are tried.
_PROBED_MARKERS: Final = 2


def check_chessboard(
    sizes: Sequence[Inner | None], read: Callable[[int], UInt8], board: CalibrationBoard
) -> None:
    """Check that the board in the images has as many corners as the user gave.

    OpenCV also detects part of a larger board, but not the same part in both cameras.

    Args:
        sizes: `grown_size` of the board found in each image, None if none was found.
        read: Returns the image of a given number, uint8 (H, W).
        board: The board that the user gave.
    """
    claimed = _sorted(board.inner)
    seen = Counter(_sorted(size) for size in sizes if size is not None)
    if not seen:
        _check_no_markers([read(n) for n in _spread(range(len(sizes)), _PROBED_MARKERS)], board)
    probed: list[Inner | None] = []
    if 2 * seen.total() < len(sizes):
        # The few detections may be parts of a larger board.
        empty = [number for number, size in enumerate(sizes) if size is None]
        probed = [probe_size(read(number)) for number in _spread(empty, _PROBED)]
    others = Counter(_sorted(size) for size in probed if size is not None)
    for votes, voters, enough in (
        (others, len(probed), _SURE),
        (seen + others, (seen + others).total(), (seen + others).total() // 2 + 1),
    ):
        size, most = next(iter(votes.most_common(1)), (claimed, 0))
        larger = any(n > m for n, m in zip(size, claimed, strict=True))
        # If the given board was seen whole, a smaller one is part of it.
        if most >= enough and size != claimed and (larger or not seen[claimed]):
            raise _wrong_size(size, f"{most} of {counted(voters, 'image')}", board)


def check_charuco(count: int, read: Callable[[int], UInt8], board: CalibrationBoard) -> None:
    """Explain why a ChArUco board was not found in any image.

    Args:
        count: Number of images.
        read: Returns the image of a given number, uint8 (H, W).
        board: The board that the user gave.
    """
    probed = [read(number) for number in _spread(range(count), _PROBED_MARKERS)]
    best, votes = _marker_votes(probed)
    if votes[best] and votes[board.dictionary] < votes[best] / 2:
        raise CalibrationError(
            "the board has markers of another dictionary",
            got=best.lower(),
            expected=board.dictionary.lower(),
            hint=f"try --board {board.kind}:{board.columns}x{board.rows}:…:{best.lower()}",
        )
    numbers = np.concatenate([find_markers(p, board.dictionary) for p in probed])
    if numbers.size:
        raise CalibrationError(
            "markers were found, but not in the layout of this board",
            got=f"marker ids up to {numbers.max()}",
            expected=f"0 to {marker_count(board) - 1} for {board.columns}x{board.rows} squares",
            hint="count squares, not corners; give columns first",
        )
    plain = [size for size in map(probe_size, probed) if size is not None]
    if plain:
        columns, rows = max(plain, key=lambda size: size[0] * size[1])
        raise CalibrationError(
            "the images show a chessboard without markers",
            got=f"{columns}x{rows} inner corners",
            expected=str(board),
            hint=f"try --board chess:{columns}x{rows}:…",
        )


def grown_size(grey: UInt8, pixels: Float64, inner: Inner) -> Inner:
    """Return columns and rows of a grid of inner corners, extended as far as corners are found.

    Args:
        grey: uint8 (H, W).
        pixels: float64 (N, 2), corners row by row.
        inner: Columns and rows of ``pixels``.
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
    """Return inner columns and rows of any chessboard in an image, or None."""
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
    # Detecting the whole extended board again rejects mere textures of squares.
    return size if find_chessboard(grey, size) is not None else None


def _spread(numbers: Sequence[int], count: int) -> list[int]:
    """Return at most ``count`` of the numbers, evenly spaced from first to last."""
    at = np.unique(np.linspace(0, len(numbers) - 1, min(count, len(numbers))).astype(int))
    return [numbers[place] for place in at]


def _sorted(size: Inner) -> Inner:
    """Return the size independent of orientation: a board may be held upright or sideways."""
    return min(size), max(size)


def _continue(grey: UInt8, grid: Float64, axis: int, usual: float) -> Float64 | None:
    """Return the grid with one more line at the end of an axis, or None if there are no corners."""
    lines = np.moveaxis(grid, axis, 0)
    if len(lines) < 3 or len(lines) >= _LARGEST:
        return None
    # Quadratic extrapolation: perspective and lens distortion curve the spacing.
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
    """Return float64 (R, C), how the diagonal pairs of quadrants of each corner differ.

    Differences within a pair count against it. NaN where a quadrant is outside the image.
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


def _marker_votes(images: Sequence[UInt8]) -> tuple[str, Counter[str]]:
    """Return the dictionary with the most markers found, and the number found of each."""
    votes = Counter(
        {
            name: sum(len(find_markers(image, name)) for image in images)
            for name in dictionary_names()
        }
    )
    return votes.most_common(1)[0][0], votes


def _check_no_markers(images: Sequence[UInt8], board: CalibrationBoard) -> None:
    best, votes = _marker_votes(images)
    if votes[best] >= _SURE * len(images):
        raise CalibrationError(
            "the images show a board with markers (ChArUco)",
            got=f"markers of {best.lower()}",
            expected=str(board),
            hint=f"try --board charuco:COLUMNSxROWS:SQUARE:MARKER:{best.lower()}, counting squares",
        )


def _wrong_size(size: Inner, where: str, board: CalibrationBoard) -> CalibrationError:
    columns, rows = size if board.columns <= board.rows else size[::-1]
    claimed = f"{board.columns}x{board.rows}"
    squares = (columns + 1, rows + 1) == (board.columns, board.rows)
    why = "count inner corners, not squares" if squares else "count the inner corners again"
    return CalibrationError(
        f"the board in the images does not have {claimed} inner corners",
        got=f"{columns}x{rows} in {where}",
        expected=claimed,
        hint=f"{why}, or give --board chess:{columns}x{rows}:…",
    )
