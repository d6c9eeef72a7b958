"""Projection and back-projection for the left view of a rectified camera."""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import NDArray

from recon.core.values.arrays import Float64
from recon.core.values.camera import RectifiedCamera


def unproject(
    u: NDArray[Any], v: NDArray[Any], depth_m: NDArray[Any], camera: RectifiedCamera
) -> NDArray[Any]:
    """Back-project pixels of known depth to points in camera axes.

    Args:
        u: (N,) columns, pixels.
        v: (N,) rows, pixels.
        depth_m: (N,) depth along the optical axis.
        camera: The rectified camera.

    Returns:
        (N, 3) in the dtype of ``depth_m``.
    """
    x = (u - camera.cx_px) * depth_m / camera.focal_px
    y = (v - camera.cy_px) * depth_m / camera.focal_px
    return np.stack([x, y, depth_m], axis=-1).astype(depth_m.dtype)


def project(
    xyz: NDArray[Any], camera: RectifiedCamera
) -> tuple[NDArray[Any], NDArray[Any], NDArray[Any]]:
    """Return columns, rows and left-to-right disparity (N,) of points (N, 3) in camera axes.

    Points at or behind the camera plane give NaN.
    """
    z = np.where(xyz[:, 2] > 0, xyz[:, 2], np.nan)
    u = camera.focal_px * xyz[:, 0] / z + camera.cx_px
    v = camera.focal_px * xyz[:, 1] / z + camera.cy_px
    d = camera.focal_px * camera.baseline_m / z - camera.doffs_px
    return u, v, d


def map_pixels(H: Float64, pixels: NDArray[Any]) -> Float64:
    """Return float64 (N, 2), pixels (N, 2) mapped by a homography (3, 3)."""
    mapped = pixels.astype(np.float64) @ H[:, :2].T + H[:, 2]
    return np.asarray(mapped[:, :2] / mapped[:, 2:])
