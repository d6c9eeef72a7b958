"""Whether the board in the images is the one that was stated, and how it lies in a second one."""

from __future__ import annotations

import math
from collections import Counter
from collections.abc import Callable, Sequence
from itertools import product
from typing import Final

import cv2
import numpy as np

from recon.core.errors import CalibrationError
from recon.core.text import counted
from recon.core.values.arrays import Float64, Int32, UInt8
from recon.core.values.board import CalibrationBoard
from recon.rig.calibrate.patterns import (
    SLOW_FLAGS,
    WINDOW,
    Inner,
    dictionaries,
    dictionary,
    find_chessboard,
    refine_corners,
)

_CORNER_CONTRAST: Final = 0.5  # least contrast of quadrants at a corner, relative to the median
_LARGEST: Final = 60
_SURE: Final = 3  # images that must agree on a size, or markers per image, to rule out chance
_PROBED: Final = 8  # images in which any board is searched if few show the given one
_PROBED_MARKERS: Final = 2  # fewer for markers: all of OpenCV's twenty dictionaries are tried


def orient_like(reference: Float64, pixels: Float64, inner: Inner) -> Float64:
    """Reorder the corners (N, 2) of a whole chessboard as in another view of it.

    OpenCV may start at any corner of the board. Of all orders that preserve neighbours, this is the
    one that resembles the reference most, up to translation and scale.
    """
    columns, rows = inner
    grid = np.arange(columns * rows).reshape(rows, columns)
    grids = (grid, grid.T) if columns == rows else (grid,)
    orders = [g[::a, ::b].ravel() for g in grids for a, b in product((1, -1), repeat=2)]
    likeness = [float((_shape(reference) * _shape(pixels[order])).sum()) for order in orders]
    return pixels[orders[int(np.argmax(likeness))]]


def _shape(pixels: Float64) -> Float64:
    centred = pixels - pixels.mean(axis=0)
    return np.asarray(centred / np.linalg.norm(centred))


def check_chessboard(
    sizes: Sequence[Inner | None], read: Callable[[int], UInt8], board: CalibrationBoard
) -> None:
    """Check that the chessboard in the images has as many corners as the user gave.

    OpenCV also detects part of a larger board, but not the same part in both cameras. ``sizes`` are
    the `grown_size` of the board in each image, None if none was found; ``read`` gives the images.
    """
    claimed = _sorted(board.inner)
    seen = Counter(_sorted(size) for size in sizes if size is not None)
    if not seen:
        probes = [read(n) for n in _spread(range(len(sizes)), _PROBED_MARKERS)]
        best, counts = _marker_votes(probes)
        if counts[best] >= _SURE * len(probes):
            raise CalibrationError(
                "the images show a board with markers (ChArUco)",
                got=f"markers of {best.lower()}",
                expected=str(board),
                hint=f"try --board charuco:COLUMNSxROWS:SQUARE:MARKER:{best.lower()}, "
                "counting squares",
            )
    probed: list[Inner | None] = []
    if 2 * seen.total() < len(sizes):
        # The few detections may be parts of a larger board.
        empty = [number for number, size in enumerate(sizes) if size is None]
        probed = [_probe_size(read(number)) for number in _spread(empty, _PROBED)]
    others = Counter(_sorted(size) for size in probed if size is not None)
    for votes, voters, enough in (
        (others, len(probed), _SURE),
        (seen + others, (seen + others).total(), (seen + others).total() // 2 + 1),
    ):
        size, most = next(iter(votes.most_common(1)), (claimed, 0))
        larger = any(n > m for n, m in zip(size, claimed, strict=True))
        # If the given board was seen whole, a smaller one is part of it.
        if most >= enough and size != claimed and (larger or not seen[claimed]):
            # A board may be held upright or sideways.
            columns, rows = size if board.columns <= board.rows else size[::-1]
            given = f"{board.columns}x{board.rows}"
            squares = (columns + 1, rows + 1) == (board.columns, board.rows)
            why = "count inner corners, not squares" if squares else "count the inner corners again"
            raise CalibrationError(
                f"the board in the images does not have {given} inner corners",
                got=f"{columns}x{rows} in {most} of {counted(voters, 'image')}",
                expected=given,
                hint=f"{why}, or give --board chess:{columns}x{rows}:…",
            )


def check_charuco(count: int, read: Callable[[int], UInt8], board: CalibrationBoard) -> None:
    """Explain why a ChArUco board was found in none of ``count`` images."""
    probed = [read(number) for number in _spread(range(count), _PROBED_MARKERS)]
    best, votes = _marker_votes(probed)
    if votes[best] and votes[board.dictionary] < votes[best] / 2:
        raise CalibrationError(
            "the board has markers of another dictionary",
            got=best.lower(),
            expected=board.dictionary.lower(),
            hint=f"try --board {board.kind}:{board.columns}x{board.rows}:…:{best.lower()}",
        )
    numbers = np.concatenate([_find_markers(p, board.dictionary) for p in probed])
    if numbers.size:
        raise CalibrationError(
            "markers were found, but not in the layout of this board",
            got=f"marker ids up to {numbers.max()}",
            expected=f"0 to {math.prod(board.squares) // 2 - 1} for {board.columns}x{board.rows} "
            "squares",
            hint="count squares, not corners; give columns first",
        )
    plain = [size for size in map(_probe_size, probed) if size is not None]
    if plain:
        columns, rows = max(plain, key=lambda size: size[0] * size[1])
        raise CalibrationError(
            "the images show a chessboard without markers",
            got=f"{columns}x{rows} inner corners",
            expected=str(board),
            hint=f"try --board chess:{columns}x{rows}:…",
        )


def grown_size(grey: UInt8, pixels: Float64, inner: Inner) -> Inner:
    """Return columns and rows of a grid of corners (N, 2), extended as far as there are corners."""
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


def _probe_size(grey: UInt8) -> Inner | None:
    flags = cv2.CALIB_CB_LARGER | SLOW_FLAGS
    found, corners, meta = cv2.findChessboardCornersSBWithMeta(grey, (3, 3), flags)
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
    longer = np.concatenate(
        [lines, refine_corners(grey, guess, np.full(len(guess), WINDOW * step))[None]]
    )
    longer = np.moveaxis(longer, 0, axis)
    added = np.moveaxis(_contrast(grey, longer), axis, 0)[-1]
    if np.isnan(added).all() or not np.nanmedian(added) > _CORNER_CONTRAST * usual:
        return None
    return longer


def _contrast(grey: UInt8, grid: Float64) -> Float64:
    """Return float64 (R, C), how diagonal quadrants of each corner differ; NaN = outside."""
    down, across = np.gradient(grid, axis=(0, 1))
    smooth, signs = cv2.blur(grey, (3, 3)), ((1, 1), (-1, -1), (1, -1), (-1, 1))
    a, b, c, d = (_sample(smooth, grid + 0.4 * (p * across + q * down)) for p, q in signs)
    # Differences within a pair count against it.
    return np.asarray(np.abs(a + b - c - d) - np.abs(a - b) - np.abs(c - d)) / 2


def _sample(grey: UInt8, places: Float64) -> Float64:
    at = np.rint(places).astype(int)
    height, width = grey.shape
    inside = ((at >= 0) & (at < (width, height))).all(axis=-1)
    x, y = np.where(inside, at[..., 0], 0), np.where(inside, at[..., 1], 0)
    return np.where(inside, grey[y, x].astype(np.float64), np.nan)


def _find_markers(grey: UInt8, name: str) -> Int32:
    numbers = cv2.aruco.ArucoDetector(dictionary(name)).detectMarkers(grey)[1]
    return np.zeros(0, np.int32) if numbers is None else np.asarray(numbers, np.int32).ravel()


def _marker_votes(images: Sequence[UInt8]) -> tuple[str, Counter[str]]:
    """Return the dictionary with the most markers found, and the number found of each."""
    counts = {n: sum(len(_find_markers(image, n)) for image in images) for n in dictionaries()}
    return max(counts, key=counts.__getitem__), Counter(counts)
