"""Corners to track, spread over the picture."""

from __future__ import annotations

import cv2
import numpy as np
from numpy.typing import NDArray

from recon.core.values.arrays import Bool, Float32, UInt8
from recon.odometry.settings import CornerSettings


def find_corners(grey: UInt8, taken_uv: Float32, settings: CornerSettings) -> Float32:
    """The best corners of each cell of a picture, away from those already tracked.

    Cells keep one strongly textured region from taking all features: only features spread over the
    picture determine the motion well.

    Args:
        grey: uint8 (H, W).
        taken_uv: float32 (N, 2), columns and rows of features already tracked; they count
            towards the limit of their cell.
        settings: Cell size, number and quality of corners.

    Returns:
        float32 (M, 2), columns and rows, pixels.

    Ref:
        Shi and Tomasi, "Good features to track", CVPR 1994.
    """
    score = cv2.cornerMinEigenVal(grey, settings.block_px, ksize=3)
    v, u = np.nonzero(_peaks(score, settings) & _free(grey.shape, taken_uv, settings))
    cells = _cell_of(np.stack([u, v], axis=1), grey.shape, settings)
    order = np.lexsort((u, v, -score[v, u], cells))
    rank = _rank_in_group(cells[order])
    missing = settings.per_cell - _count_per_cell(taken_uv, grey.shape, settings)
    keep = order[rank < missing[cells[order]]]
    return np.stack([u[keep], v[keep]], axis=1).astype(np.float32)


def _peaks(score: Float32, settings: CornerSettings) -> Bool:
    """Local maxima of the score that are good enough and away from the border."""
    size = 2 * settings.distance_px + 1
    peak = score >= cv2.dilate(score, np.ones((size, size), np.uint8))
    peak &= score > settings.min_score
    inside = np.zeros_like(peak)
    border = settings.border_px
    inside[border : -border or None, border : -border or None] = True
    return np.asarray(peak & inside)


def _free(shape: tuple[int, ...], taken_uv: Float32, settings: CornerSettings) -> Bool:
    """Pixels away from every feature already tracked."""
    free = np.ones(shape, np.uint8)
    for u, v in np.rint(taken_uv).astype(int).tolist():
        cv2.circle(free, (u, v), settings.distance_px, 0, -1)
    return free.astype(np.bool_)


def _cell_of(
    uv: NDArray[np.generic], shape: tuple[int, ...], settings: CornerSettings
) -> NDArray[np.int64]:
    """Number of the cell of each pixel (N, 2)."""
    size = settings.cell_px
    columns = -(-shape[1] // size)
    u = np.clip(np.rint(uv[:, 0]).astype(np.int64), 0, shape[1] - 1)
    v = np.clip(np.rint(uv[:, 1]).astype(np.int64), 0, shape[0] - 1)
    cell: NDArray[np.int64] = (v // size) * columns + u // size
    return cell


def _count_per_cell(
    uv: Float32, shape: tuple[int, ...], settings: CornerSettings
) -> NDArray[np.int64]:
    size = settings.cell_px
    cells = -(-shape[0] // size) * -(-shape[1] // size)
    return np.bincount(_cell_of(uv, shape, settings), minlength=cells)


def _rank_in_group(groups: NDArray[np.int64]) -> NDArray[np.int64]:
    """Position of each element within its run of equal values."""
    index = np.arange(len(groups))
    starts = np.r_[True, groups[1:] != groups[:-1]] if len(groups) else np.zeros(0, np.bool_)
    rank: NDArray[np.int64] = index - np.maximum.accumulate(np.where(starts, index, 0))
    return rank
