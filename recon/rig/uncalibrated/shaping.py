"""Degrees of freedom left by row alignment: scale, shear, translation and smallest disparity."""

from __future__ import annotations

from typing import Final

import numpy as np

from recon.core.geometry.projection import map_pixels
from recon.core.values.arrays import Float64
from recon.stereo.rectify.features import PairFeatures

Size = tuple[int, int]

# Disparity given to the farthest matches; a matcher searches from 0.
_SMALLEST_DISPARITY_PX: Final = 4.0


def shape_views(
    H_left: Float64, H_right: Float64, features: PairFeatures, size: Size
) -> tuple[Float64, Float64]:
    """Choose the degrees of freedom of two row-aligning homographies; rows stay aligned.

    Both images become upright, centred, sheared as little as possible and of about their original
    size, and the right image is shifted so that disparities are positive.

    Args:
        H_left: float64 (3, 3).
        H_right: float64 (3, 3).
        features: Correct matches, raw pixels.
        size: (width, height) of the images.

    Ref: Loop and Zhang 1999, "Computing rectifying homographies for stereo vision", section 6.
    """
    upright = np.diag([1.0, np.sign(_upright(H_left, size)) or 1.0, 1.0])
    views = [_straight(H, size) for H in _levelled(upright @ H_left, upright @ H_right, size)]
    height = float(np.mean([_extent(H, size)[1] for H in views]))
    scale = size[1] / height
    views = [_scaled(H, scale, size) for H in views]
    middle = np.mean([_middle(H, size)[1] for H in views])
    left, right = (
        _shift(size[0] / 2 - 0.5 - _middle(H, size)[0], size[1] / 2 - 0.5 - middle) @ H
        for H in views
    )
    a, b = map_pixels(left, features.left_uv), map_pixels(right, features.right_uv)
    least = float(np.percentile(a[:, 0] - b[:, 0], 1))
    return left, _shift(least - _SMALLEST_DISPARITY_PX, 0.0) @ right


def _levelled(H_left: Float64, H_right: Float64, size: Size) -> list[Float64]:
    """Tilt both images together about a horizontal axis, until top and bottom have equal scale.

    Rows stay aligned under (x, y) -> (x, y) / (1 + g·y). The scale at a pixel depends on its third
    coordinate: g makes this as even as possible along the borders of both images.
    """
    points = np.hstack([np.concatenate([_middles(size), _corners(size)]), np.ones((8, 1))])
    views = [H / (points @ H[2]).mean() for H in (H_left, H_right)]
    middle = float(np.mean([_middle(H, size)[1] for H in views]))
    views = [_shift(0.0, -middle) @ H for H in views]
    y, w = (np.stack([points @ H[row] for H in views]) for row in (1, 2))
    y, w = y - y.mean(axis=1, keepdims=True), w - w.mean(axis=1, keepdims=True)
    tip = np.eye(3)
    tip[2, 1] = -float((y * w).sum() / (y * y).sum())
    return [tip @ H for H in views]


def _corners(size: Size) -> Float64:
    w, h = size[0] - 1.0, size[1] - 1.0
    return np.array([[0, 0], [w, 0], [w, h], [0, h]])


def _middles(size: Size) -> Float64:
    """Return float64 (4, 2), the midpoints of the left, right, top and bottom border."""
    w, h = size[0] - 1.0, size[1] - 1.0
    return np.array([[0, h / 2], [w, h / 2], [w / 2, 0], [w / 2, h]])


def _upright(H: Float64, size: Size) -> float:
    """Return a positive number if the bottom border stays below the top border."""
    _, _, top, bottom = map_pixels(H, _middles(size))
    return float(bottom[1] - top[1])


def _straight(H: Float64, size: Size) -> Float64:
    """Shear and stretch along x so that the centre lines keep their right angle and proportion."""
    left, right, top, bottom = map_pixels(H, _middles(size))
    across, down = right - left, bottom - top
    w, h = size
    # x' = s·x + k·y: across' · down' = 0 and |across'| / |down'| = w / h, with y as it is.
    (ax, ay), (dx, dy) = across, down
    cross = dx * ay - dy * ax
    s = (h**2 * ay**2 + w**2 * dy**2) / (h * w * cross)
    k = (h**2 * ax * ay + w**2 * dx * dy) / (-h * w * cross)
    if s * ax + k * ay < 0:
        s, k = -s, -k
    return np.array([[s, k, 0.0], [0.0, 1.0, 0.0], [0.0, 0.0, 1.0]]) @ H


def _extent(H: Float64, size: Size) -> Float64:
    """Return the width and height of the mapped centre lines."""
    left, right, top, bottom = map_pixels(H, _middles(size))
    return np.array([np.linalg.norm(right - left), abs(bottom[1] - top[1])])


def _scaled(H: Float64, scale: float, size: Size) -> Float64:
    """Scale the rows of both images alike, and columns so that the aspect ratio is kept."""
    width = _extent(H, size)[0] * scale
    return np.diag([scale * size[0] / width, scale, 1.0]) @ H


def _middle(H: Float64, size: Size) -> Float64:
    return np.asarray(map_pixels(H, np.array([[(size[0] - 1) / 2, (size[1] - 1) / 2]]))[0])


def _shift(x: float, y: float) -> Float64:
    return np.array([[1.0, 0.0, x], [0.0, 1.0, y], [0.0, 0.0, 1.0]])
