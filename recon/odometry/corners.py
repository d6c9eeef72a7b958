"""Corners to track, spread over the image, and kept so."""

from __future__ import annotations

from typing import Final

import cv2
import numpy as np
from numpy.typing import NDArray

from recon.core.values.arrays import Bool, Float32, Float64, UInt8
from recon.stereo.match.sad import halve

_CELL_PX: Final = 40
"""Edge of a cell of the image."""

_PER_CELL: Final = 3
"""Corners that a cell may hold."""

_DISTANCE_PX: Final = 6
"""Least distance between two corners."""

_BLOCK_PX: Final = 5
"""Edge of the neighbourhood that the corner score is computed in."""

_MIN_SCORE: Final = 2e-4
"""Least eigenvalue of the gradients' covariance, OpenCV's scale."""

_BORDER_PX: Final = 8
"""Corners nearer to the border are not used."""


def find_corners(
    grey: UInt8, taken_uv: Float32, *, cell_px: int = _CELL_PX, per_cell: int = _PER_CELL
) -> Float32:
    """Return the best corners of each cell of an image, away from those already tracked.

    Cells keep one strongly textured region from taking all features: only features spread over the
    image determine the motion well.

    Args:
        grey: uint8 (H, W).
        taken_uv: float32 (N, 2), columns and rows of features already tracked; they count
            towards the limit of their cell.
        cell_px: Edge of a cell of the image.
        per_cell: Corners that a cell may hold.

    Returns:
        float32 (M, 2), columns and rows, pixels.

    Ref:
        Shi and Tomasi, "Good features to track", CVPR 1994.
    """
    score = cv2.cornerMinEigenVal(grey, _BLOCK_PX, ksize=3)
    # Over a whole image, `nonzero` takes six times as long.
    v, u = np.divmod(np.flatnonzero(_peaks(score) & _free(grey.shape, taken_uv)), grey.shape[1])
    cells = _cell_of(np.stack([u, v], axis=1), grey.shape, cell_px)
    order = np.lexsort((u, v, -score[v, u], cells))
    rank = _rank_in_group(cells[order])
    missing = per_cell - _count_per_cell(taken_uv, grey.shape, cell_px)
    keep = order[rank < missing[cells[order]]]
    return np.stack([u[keep], v[keep]], axis=1).astype(np.float32)


def in_crowd(uv: Float64, shape: tuple[int, ...]) -> Bool:
    """Return which features are more than their cell may hold; those that come first stay.

    Where a camera drives backwards, or turns away, features that are followed gather far ahead, and
    would outnumber those that are near.

    Args:
        uv: float64 (N, 2), columns and rows; NaN = not seen.
        shape: Height and width of the image.

    Returns:
        bool (N,), False where not seen.
    """
    crowd, seen = np.zeros(len(uv), np.bool_), np.flatnonzero(np.isfinite(uv[:, 0]))
    cells = _cell_of(uv[seen], shape, _CELL_PX)
    order = np.argsort(cells, kind="stable")
    crowd[seen[order]] = _rank_in_group(cells[order]) >= _PER_CELL
    return crowd


def find_fewer_corners(grey: UInt8, taken_uv: Float32) -> Float32:
    """Return corners like `find_corners`, a third as many, found at half size.

    Finding and using them takes a quarter of the time: for drives that are mapped live.
    """
    taken = (0.5 * (taken_uv - np.float32(0.5))).astype(np.float32)
    cells = {"cell_px": _CELL_PX * 3 // 5, "per_cell": _PER_CELL - 1}
    uv: Float32 = 2 * find_corners(halve(grey), taken, **cells) + np.float32(0.5)
    return uv


def _peaks(score: Float32) -> Bool:
    """Return local maxima of the score that are good enough and away from the border."""
    size = 2 * _DISTANCE_PX + 1
    peak = score >= cv2.dilate(score, np.ones((size, size), np.uint8))
    peak &= score > _MIN_SCORE
    inside = np.zeros_like(peak)
    border = _BORDER_PX
    inside[border : -border or None, border : -border or None] = True
    return np.asarray(peak & inside)


def _free(shape: tuple[int, ...], taken_uv: Float32) -> Bool:
    """Return pixels away from every feature already tracked."""
    free = np.ones(shape, np.uint8)
    for u, v in np.rint(taken_uv).astype(int).tolist():
        cv2.circle(free, (u, v), _DISTANCE_PX, 0, -1)
    return free.astype(np.bool_)


def _cell_of(uv: NDArray[np.generic], shape: tuple[int, ...], size: int) -> NDArray[np.int64]:
    """Return the number of the cell of each pixel (N, 2)."""
    columns = -(-shape[1] // size)
    u = np.clip(np.rint(uv[:, 0]).astype(np.int64), 0, shape[1] - 1)
    v = np.clip(np.rint(uv[:, 1]).astype(np.int64), 0, shape[0] - 1)
    cell: NDArray[np.int64] = (v // size) * columns + u // size
    return cell


def _count_per_cell(uv: Float32, shape: tuple[int, ...], size: int) -> NDArray[np.int64]:
    cells = -(-shape[0] // size) * -(-shape[1] // size)
    return np.bincount(_cell_of(uv, shape, size), minlength=cells)


def _rank_in_group(groups: NDArray[np.int64]) -> NDArray[np.int64]:
    """Return the position of each element within its run of equal values."""
    index = np.arange(len(groups))
    starts = np.r_[True, groups[1:] != groups[:-1]] if len(groups) else np.zeros(0, np.bool_)
    rank: NDArray[np.int64] = index - np.maximum.accumulate(np.where(starts, index, 0))
    return rank
