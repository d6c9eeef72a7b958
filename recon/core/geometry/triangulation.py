"""Conversion between disparity and depth, and the resulting depth error."""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import NDArray

from recon.core.values.arrays import Float32
from recon.core.values.camera import RectifiedCamera


def depth_from_disparity(disparity_px: NDArray[Any], camera: RectifiedCamera) -> Float32:
    """Return the depth along the optical axis, ``Z = f·b / (d + doffs)``.

    Args:
        disparity_px: Any shape, pixels; NaN = unknown.
        camera: The rectified camera.

    Returns:
        float32, metres; NaN where the disparity is unknown or not in front of the camera.
    """
    shifted = np.asarray(disparity_px, dtype=np.float64) + camera.doffs_px
    # A depth that overflows float32 is infinite.
    with np.errstate(divide="ignore", invalid="ignore", over="ignore"):
        depth = camera.focal_px * camera.baseline_m / shifted
        return np.where(shifted > 0, depth, np.nan).astype(np.float32)


def disparity_from_depth(depth_m: NDArray[Any], camera: RectifiedCamera) -> Float32:
    """Return inverse of `depth_from_disparity`; NaN where the depth is unknown or not positive."""
    depth = np.asarray(depth_m, dtype=np.float64)
    with np.errstate(divide="ignore", invalid="ignore"):
        disparity = camera.focal_px * camera.baseline_m / depth - camera.doffs_px
    return np.where(depth > 0, disparity, np.nan).astype(np.float32)


def depth_sigma(
    depth_m: NDArray[Any], sigma_px: NDArray[Any] | float, camera: RectifiedCamera
) -> Float32:
    """Return the standard deviation of the depth, ``sigma_z = Z²·sigma_d / (f·b)`` (first order).

    Args:
        depth_m: Any shape, metres.
        sigma_px: Standard deviation of the disparity, pixels.
        camera: The rectified camera.
    """
    fb = camera.focal_px * camera.baseline_m
    sigma = np.asarray(depth_m, dtype=np.float64) ** 2 * sigma_px / fb
    return np.asarray(sigma, dtype=np.float32)
