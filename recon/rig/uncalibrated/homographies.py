"""Rectifying homographies, with what aligned rows leave open: scale, shear, least disparity."""

from __future__ import annotations

from typing import Final

import cv2
import numpy as np

from recon.core.errors import CalibrationError
from recon.core.geometry.projection import map_pixels
from recon.core.values.arrays import Float64
from recon.stereo.rectify.features import PairFeatures

Size = tuple[int, int]
Homographies = tuple[Float64, Float64]

_MOST_STRETCHED: Final = 20.0  # largest ratio of the scales at two corners of an image
_SMALLEST_DISPARITY_PX: Final = 4.0  # of the farthest matches; a matcher searches from 0


def rectifying_homographies(F: Float64, features: PairFeatures, size: Size) -> Homographies:
    """Return float64 (3, 3) for the left and for the right image, which align matching rows.

    The borders of both images stay as near to their places as aligned rows allow, and then the
    right image is shifted so that disparities are positive.

    Args:
        F: float64 (3, 3), ``right.T @ F @ left = 0``.
        features: Correct matches, raw pixels.
        size: (width, height) of the images.

    Ref: Hartley 1999, "Theory and practice of projective rectification", as OpenCV has it.
    """
    left_px, right_px = features.left_uv.astype(np.float64), features.right_uv.astype(np.float64)
    _, *found = cv2.stereoRectifyUncalibrated(left_px, right_px, F, size, threshold=0)
    x, y = np.meshgrid(np.linspace(0, size[0] - 1, 3), np.linspace(0, size[1] - 1, 3))
    border = np.delete(np.stack([x.ravel(), y.ravel()], axis=1), 4, axis=0)
    views = _levelled([np.asarray(H, np.float64) for H in found], border)
    moved = [map_pixels(H, border) for H in views]
    # Rows are scaled and shifted alike; columns of each image scaled, sheared and shifted.
    rows = _affine(np.concatenate(moved)[:, 1:], np.tile(border[:, 1], 2))
    left, right = (
        np.array([_affine(places, border[:, 0]), [0.0, *rows], [0.0, 0.0, 1.0]]) @ H
        for places, H in zip(moved, views, strict=True)
    )
    columns = map_pixels(left, left_px)[:, 0] - map_pixels(right, right_px)[:, 0]
    least = float(np.percentile(columns, 1)) - _SMALLEST_DISPARITY_PX
    return left, np.array([[1.0, 0.0, least], [0.0, 1.0, 0.0], [0.0, 0.0, 1.0]]) @ right


def _levelled(views: list[Float64], border: Float64) -> list[Float64]:
    """Tilt both images together about a horizontal axis, until top and bottom have equal scale.

    Rows stay aligned under (x, y) -> (x, y) / (1 + g·(y - y0)). The scale at a pixel depends on its
    third coordinate: g makes this as even as possible along the borders of both images.
    """
    points = np.hstack([border, np.ones((len(border), 1))])
    views = [H / (points @ H[2]).mean() for H in views]
    for side, H in zip(("left", "right"), views, strict=True):
        depth = points @ H[2]
        if not depth.min() > depth.max() / _MOST_STRETCHED:  # also where it is NaN
            raise CalibrationError(
                f"the {side} image sees the other camera: one is in front of the other",
                got="epipole in it, or close to its border",
                expected="outside the image",
                hint="put the cameras side by side",
            )
    y0 = float(np.mean([map_pixels(H, border.mean(axis=0)[None])[0, 1] for H in views]))
    rows, depth = (
        np.stack([points @ (H[k] - shift * H[2]) for H in views]) for k, shift in ((1, y0), (2, 0))
    )
    rows, depth = (each - each.mean(axis=1, keepdims=True) for each in (rows, depth))
    g = -float((rows * depth).sum() / (rows * rows).sum())
    return [np.array([[1.0, 0.0, 0.0], [0.0, 1.0, 0.0], [0.0, g, 1.0 - g * y0]]) @ H for H in views]


def _affine(places: Float64, wanted: Float64) -> Float64:
    """Return the factors of the coordinates (N, k) and the shift that give (N,) numbers best."""
    found = np.linalg.lstsq(np.column_stack([places, np.ones(len(places))]), wanted, rcond=None)
    return np.asarray(found[0], dtype=np.float64)
