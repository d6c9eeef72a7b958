"""Points for ICP: the pixels that stereo measures well."""

from __future__ import annotations

from typing import Final

import cv2
import numpy as np

from recon.core.geometry.projection import depth_from_disparity, depth_sigma, unproject
from recon.core.values import Disparity, PointCloud
from recon.core.values.arrays import Bool, Float32, UInt8
from recon.odometry.protocol import OdometryFrame

_MIN_GRADIENT: Final = 100.0
"""Least horizontal gradient, 3x3 Sobel of grey values."""

_MAX_DISPARITY_STEP_PX: Final = 0.5
"""Largest difference between a disparity and the median around it."""

_MIN_RANGE_M: Final = 1.0
"""Nearer points are not used."""

_MAX_SIGMA_M: Final = 1.0
"""Points with a less certain depth are not used."""


def select_points(frame: OdometryFrame, max_range_m: float) -> PointCloud:
    """Return near, textured points whose disparity agrees with its neighbours.

    Dense stereo clouds are smeared along the rays where there is little texture, and extend the
    ground towards the camera; ICP on all points underestimates forward motion.

    Args:
        frame: Images and disparity.
        max_range_m: Farther points are not used.

    Returns:
        Points in camera axes with ``sigma_m``; perhaps none.
    """
    camera = frame.pair.camera
    depth = depth_from_disparity(frame.disparity.values, camera)
    sigma = depth_sigma(depth, frame.disparity.sigma_px, camera)
    with np.errstate(invalid="ignore"):
        good = (depth >= _MIN_RANGE_M) & (depth <= max_range_m)
        good &= sigma <= _MAX_SIGMA_M
    good &= textured(frame.pair.left, _MIN_GRADIENT)
    good &= consistent(frame.disparity, _MAX_DISPARITY_STEP_PX)
    return _cloud(frame, depth, sigma, good)


def textured(grey: UInt8, min_gradient: float) -> Bool:
    """Return bool (H, W), where the image changes along the row: only that fixes a disparity."""
    gradient = cv2.Sobel(grey, cv2.CV_32F, 1, 0, ksize=3)
    return np.asarray(np.abs(gradient) > min_gradient)


def consistent(disparity: Disparity, max_step_px: float) -> Bool:
    """Return bool (H, W), where a disparity is close to the median of its 5×5 neighbours.

    Pixels without a match count as far away, so the rims of matched regions fall out too.
    """
    values = np.where(disparity.valid, disparity.values, np.float32(-1e6)).astype(np.float32)
    return np.asarray(disparity.valid & (np.abs(cv2.medianBlur(values, 5) - values) <= max_step_px))


def _cloud(frame: OdometryFrame, depth: Float32, sigma: Float32, where: Bool) -> PointCloud:
    v, u = np.nonzero(where)
    xyz = unproject(u, v, depth[where], frame.pair.camera)
    return PointCloud(xyz=xyz, sigma_m=sigma[where], frame="camera")
