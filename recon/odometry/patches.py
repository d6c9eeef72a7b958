"""Features found again where a motion says they are, as it says they look.

Tracking looks for a patch as it was. From one frame to the next a patch on a near surface grows by
half or leans, and is lost; but near features alone fix how far the camera moved. Far ones say it
only as well as the rig is calibrated: a quarter of a pixel is 1 % of the depth at 15 m.
"""

from __future__ import annotations

from typing import Final

import numpy as np

from recon.core.geometry.se3 import apply
from recon.core.values import Disparity, RectifiedCamera, RectifiedPair
from recon.core.values.arrays import Float64, UInt8
from recon.odometry.kernels.patches import Placing, place_patches

_PLACING: Final = Placing(radius=6, steps=10, close=0.03, reach=3.0)
"""Patches of 13 pixels, within 3 pixels of where the motion says."""

_MIN_CORRELATION: Final = 0.75  # least correlation of a patch with the one it is found as
_ROW_PX: Final = 1.0  # largest difference between the rows of a feature in the two images of a pair
_SLOPE_PX: Final = 6
"""Half width of the neighbourhood whose disparities give the slope of a surface; of which every
second row and column is taken, as neighbours share their windows anyhow."""

_ON_SURFACE_PX: Final = 1.0
"""Largest difference between the disparity of a feature's surface and that of a neighbour on it."""

_MIN_NEIGHBOURS: Final = 6  # with fewer neighbours on the surface it counts as upright
_ROUNDS: Final = 3  # fits of a surface, each to the neighbours that are on the last


def find_again(
    source: UInt8, target: UInt8, uv: Float64, warp: Float64, guess_uv: Float64
) -> Float64:
    """Find warped patches of one image in another, near a guess; NaN where nothing is alike.

    ``warp`` (N, 2, 2) says what becomes of a small offset; ``guess_uv`` (N, 2) where they should
    be.
    """
    place, correlation = place_patches(source, target, uv, warp, guess_uv, _PLACING)
    with np.errstate(invalid="ignore"):
        alike = correlation >= _MIN_CORRELATION
    return np.where(alike[:, None], place, np.nan)


def warp_of(
    uv: Float64, xyz: Float64, slope: Float64, T_target_source: Float64, camera: RectifiedCamera
) -> Float64:
    """What a motion makes of small offsets around features: float64 (N, 2, 2).

    A surface of which the disparity changes linearly is a plane, and its image after a motion is a
    homography of the one before; this is its derivative. ``slope`` (N, 2) is the change of the
    surface's disparity per pixel to the right and down, ``xyz`` (N, 3) in the axes of the source.

    Ref: Hartley and Zisserman, "Multiple view geometry", 2nd ed., section 13.1.
    """
    moved = apply(T_target_source, xyz) / xyz[:, 2:]
    R, t = T_target_source[:3, :3], T_target_source[:3, 3]
    # Along the row and the column: of the ray, and of the inverse depth times the translation.
    by_offset = R[:, :2] + slope[:, None, :] / camera.baseline_m * t[:, None]
    image = moved[:, :2] / moved[:, 2:]
    return np.asarray(
        (by_offset[:, :2] - image[:, :, None] * by_offset[:, 2:]) / moved[:, 2:, None]
    )


def measure_disparity(pair: RectifiedPair, uv: Float64, near: Float64, slope: Float64) -> Float64:
    """The disparity (N,) of features, measured in the images near a guess, which may be NaN.

    NaN where nothing alike is found on that row; ``slope`` as in `warp_of`.
    """
    there = find_in_right(pair, uv, near, slope)
    with np.errstate(invalid="ignore"):
        same_row = np.abs(there[:, 1] - uv[:, 1]) <= _ROW_PX
    return np.where(same_row, uv[:, 0] - there[:, 0], np.nan)


def find_in_right(pair: RectifiedPair, uv: Float64, near: Float64, slope: Float64) -> Float64:
    """Columns and rows (N, 2) of features in the right image; see `measure_disparity`."""
    warp = np.tile(np.eye(2), (len(uv), 1, 1))
    warp[:, 0] -= slope
    return find_again(pair.left, pair.right, uv, warp, uv - near[:, None] * [1.0, 0.0])


def surface_slopes(disparity: Disparity, uv: Float64) -> Float64:
    """Slopes of the disparity around features: float64 (N, 2), per pixel right and down.

    A plane is fitted to the neighbours that lie on it; 0 where there are too few.
    """
    offset = np.arange(-_SLOPE_PX, _SLOPE_PX + 1, 2)
    right, down = (x.ravel() for x in np.meshgrid(offset, offset))
    column, row = np.rint(uv).astype(np.int64).T
    height, width = disparity.values.shape
    rows, columns = row[:, None] + down, column[:, None] + right
    inside = (rows >= 0) & (rows < height) & (columns >= 0) & (columns < width)
    around = disparity.values[np.clip(rows, 0, height - 1), np.clip(columns, 0, width - 1)]
    around = np.where(inside, around, np.nan).astype(np.float64)
    A = np.stack([np.ones(len(right)), right, down], axis=1).astype(np.float64)
    plane = np.zeros((len(uv), 3))
    plane[:, 0] = disparity.values[np.clip(row, 0, height - 1), np.clip(column, 0, width - 1)]
    for _ in range(_ROUNDS):
        plane = _refitted(plane, A, around)
    return plane[:, 1:]


def _refitted(plane: Float64, A: Float64, around: Float64) -> Float64:
    """Planes (N, 3), fitted to the neighbours (N, K) on the last ones; upright if few."""
    with np.errstate(invalid="ignore"):
        on = (np.abs(around - plane @ A.T) <= _ON_SURFACE_PX).astype(np.float64)
    enough = on.sum(axis=1) >= _MIN_NEIGHBOURS
    terms = (A[:, :, None] * A[:, None, :]).reshape(-1, 9)
    # A pixel of ridge: neighbours in one line fix no slope across it.
    H = (on @ terms).reshape(-1, 3, 3) + np.diag([0.0, 1.0, 1.0])
    H[~enough] = np.eye(3)
    g = (on * np.nan_to_num(around)) @ A
    fitted = np.linalg.solve(H, g[:, :, None])[:, :, 0]
    return np.where(enough[:, None], fitted, plane * [1.0, 0.0, 0.0])
