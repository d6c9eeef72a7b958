"""Normals straight from a disparity map: cheap, because a plane is linear there too."""

from __future__ import annotations

import cv2
import numpy as np
from numpy.typing import NDArray

from recon.structures import RectifiedCamera
from recon.structures.arrays import Float32

Pixels = tuple[NDArray[np.intp], NDArray[np.intp]]

_MIN_DETERMINANT = 1e-6


def normals_from_disparity(
    values: Float32, at: Pixels, camera: RectifiedCamera, radius_px: int
) -> Float32:
    """Unit normals of the surface at some pixels of a disparity map.

    With focal length f, a plane ``n·X = 1`` is ``d + doffs = p·(u - cx) + q·(v - cy) + r`` in the
    disparity map, and ``n`` is parallel to ``(p·f, q·f, r)``. So a least-squares plane through the
    disparities of a window gives the normal without a search for neighbours, and its sign.

    Args:
        values: float32 (H, W), disparities, NaN = unknown.
        at: Rows (N,) and columns (N,) of the pixels wanted; they have a disparity.
        camera: The rectified camera.
        radius_px: Half width of the window.

    Returns:
        float32 (N, 3), towards the camera; along the optical axis where the window does not
        fix a plane (a lone pixel or line).
    """
    rows, columns = at
    slope_u, slope_v = _slopes(values, at, radius_px)
    u, v = columns - camera.cx_px, rows - camera.cy_px
    at_centre = values[at] + camera.doffs_px - slope_u * u - slope_v * v
    f = camera.focal_px
    normals = -np.stack([slope_u * f, slope_v * f, at_centre], axis=1).astype(np.float32)
    normals /= np.maximum(np.linalg.norm(normals, axis=1, keepdims=True), np.float32(1e-12))
    return np.asarray(normals, dtype=np.float32)


def _slopes(values: Float32, at: Pixels, radius_px: int) -> tuple[Float32, Float32]:
    """Disparity gradients (along u, along v) of the plane fitted to the window of each pixel."""
    known = np.isfinite(values)
    mask = known.astype(np.float32)
    masked = np.where(known, values, np.float32(0))
    one = np.ones(2 * radius_px + 1, dtype=np.float32)
    ramp = np.arange(-radius_px, radius_px + 1, dtype=np.float32)

    def moment(image: Float32, along_u: Float32, along_v: Float32) -> NDArray[np.float64]:
        filtered = cv2.sepFilter2D(image, cv2.CV_32F, along_u, along_v, borderType=0)
        return np.asarray(filtered[at], dtype=np.float64)

    n = moment(mask, one, one)
    mean_u, mean_v = moment(mask, ramp, one) / n, moment(mask, one, ramp) / n
    mean_d = moment(masked, one, one) / n
    uu = moment(mask, ramp**2, one) / n - mean_u**2
    vv = moment(mask, one, ramp**2) / n - mean_v**2
    uv = moment(mask, ramp, ramp) / n - mean_u * mean_v
    ud = moment(masked, ramp, one) / n - mean_u * mean_d
    vd = moment(masked, one, ramp) / n - mean_v * mean_d
    determinant = uu * vv - uv**2
    # Known pixels on one line leave the plane free to turn about it: no slope is claimed there.
    inverse = np.where(determinant > _MIN_DETERMINANT, 1.0, 0.0) / np.maximum(
        determinant, _MIN_DETERMINANT
    )
    slope_u = (ud * vv - vd * uv) * inverse
    slope_v = (vd * uu - ud * uv) * inverse
    return slope_u.astype(np.float32), slope_v.astype(np.float32)
