"""Projection and back-projection for a rectified camera: pixels, disparity, depth and its error."""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import NDArray

from recon.core.values.arrays import Float32, Float64
from recon.core.values.camera import RectifiedCamera


def unproject(
    u: NDArray[Any], v: NDArray[Any], depth_m: NDArray[Any], camera: RectifiedCamera
) -> NDArray[Any]:
    """Return points (N, 3), camera axes, of pixels (N,) of known depth along the optical axis."""
    x = (u - camera.cx_px) * depth_m / camera.focal_px
    y = (v - camera.cy_px) * depth_m / camera.focal_px
    return np.stack([x, y, depth_m], axis=-1).astype(depth_m.dtype)


def project(
    xyz: NDArray[Any], camera: RectifiedCamera
) -> tuple[NDArray[Any], NDArray[Any], NDArray[Any]]:
    """Return columns, rows and disparity (N,) of points (N, 3), camera axes; behind it NaN."""
    z = np.where(xyz[:, 2] > 0, xyz[:, 2], np.nan)
    u = camera.focal_px * xyz[:, 0] / z + camera.cx_px
    v = camera.focal_px * xyz[:, 1] / z + camera.cy_px
    d = camera.focal_px * camera.baseline_m / z - camera.doffs_px
    return u, v, d


def map_pixels(H: Float64, pixels: NDArray[Any]) -> Float64:
    """Return float64 (N, 2), pixels (N, 2) mapped by a homography (3, 3)."""
    mapped = pixels.astype(np.float64) @ H[:, :2].T + H[:, 2]
    return np.asarray(mapped[:, :2] / mapped[:, 2:])


def depth_from_disparity(disparity_px: NDArray[Any], camera: RectifiedCamera) -> Float32:
    """Return ``Z = f·b / (d + doffs)``, float32; NaN where d is NaN or Z is not in front."""
    shifted = np.asarray(disparity_px, dtype=np.float64) + camera.doffs_px
    # A depth that overflows float32 is infinite.
    with np.errstate(divide="ignore", invalid="ignore", over="ignore"):
        depth = camera.focal_px * camera.baseline_m / shifted
        return np.where(shifted > 0, depth, np.nan).astype(np.float32)


def disparity_from_depth(depth_m: NDArray[Any], camera: RectifiedCamera) -> Float32:
    """Return the disparity of a depth; NaN where the depth is unknown or not positive."""
    depth = np.asarray(depth_m, dtype=np.float64)
    with np.errstate(divide="ignore", invalid="ignore"):
        disparity = camera.focal_px * camera.baseline_m / depth - camera.doffs_px
    return np.where(depth > 0, disparity, np.nan).astype(np.float32)


def depth_sigma(
    depth_m: NDArray[Any], sigma_px: NDArray[Any] | float, camera: RectifiedCamera
) -> Float32:
    """Return the standard deviation of the depth, to first order: ``Z²·sigma_d / (f·b)``."""
    fb = camera.focal_px * camera.baseline_m
    sigma = np.asarray(depth_m, dtype=np.float64) ** 2 * sigma_px / fb
    return np.asarray(sigma, dtype=np.float32)
