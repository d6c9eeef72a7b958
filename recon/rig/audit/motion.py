"""Measures from motion: apparent speed of the rig, and time skew between the cameras."""

from __future__ import annotations

import math
from typing import Final

import cv2
import numpy as np

from recon.core.values import RectifiedCamera
from recon.core.values.arrays import Bool, Float32, Float64, UInt8
from recon.odometry.pnp import find_consensus, fit_pose

_MIN_POINTS: Final = 20
_MIN_DISPARITY_PX: Final = 2.0
_AGREE_PX: Final = 2.0
# Features must move at least this many rows per frame to reveal a time skew.
_MIN_FLOW_PX: Final = 1.0


def track(now: UInt8, then: UInt8, uv: Float32) -> tuple[Float32, Bool]:
    """Track features from one image to the next (Lucas-Kanade).

    Args:
        now: uint8 (H, W).
        then: uint8 (H, W), a frame later.
        uv: float32 (N, 2), features of ``now``.

    Returns:
        float32 (N, 2), positions in ``then``; and bool (N,), True where tracking back returns to
        the start.
    """
    if not len(uv):
        return uv, np.zeros(0, np.bool_)
    there, found, _ = cv2.calcOpticalFlowPyrLK(now, then, uv[:, None], None, winSize=(21, 21))
    back, again, _ = cv2.calcOpticalFlowPyrLK(then, now, there, None, winSize=(21, 21))
    near = np.abs(back.reshape(-1, 2) - uv).max(axis=1) < 0.5
    return there.reshape(-1, 2), np.asarray((found.ravel() > 0) & (again.ravel() > 0) & near)


def measure_speed(
    left_uv: Float32, right_uv: Float32, later_uv: Float32, camera: RectifiedCamera
) -> float | None:
    """Distance in metres that the rig moves between two frames, if the calibration is correct.

    Args:
        left_uv: float32 (N, 2), features in the left image.
        right_uv: float32 (N, 2), the same features in the right image.
        later_uv: float32 (N, 2), the same features in the left image of the next frame.
        camera: The rectified camera.

    Returns:
        None if too few features agree on one motion.
    """
    disparity = left_uv[:, 0] - right_uv[:, 0] + camera.doffs_px
    near = disparity > _MIN_DISPARITY_PX
    if near.sum() < _MIN_POINTS:
        return None
    depth_m = camera.focal_px * camera.baseline_m / disparity[near].astype(np.float64)
    rays = np.linalg.inv(camera.matrix) @ np.vstack([left_uv[near].T, np.ones(near.sum())])
    xyz = (rays * depth_m).T
    found = find_consensus(
        xyz,
        later_uv[near].astype(np.float64),
        camera,
        limit_px=_AGREE_PX,
        iterations=100,
        min_inliers=max(_MIN_POINTS, math.ceil(0.4 * near.sum())),
    )
    if found is None:
        return None
    T = fit_pose(xyz[found.agree], later_uv[near][found.agree].astype(np.float64), camera)
    return float(np.linalg.norm(T[:3, 3]))


def measure_time_skew(row_error_px: Float64, row_flow_px: Float64) -> tuple[float, float] | None:
    """Delay of the right camera in frames, from the vertical motion of features.

    A camera that is s frames late sees a feature whose row moves by v per frame v·s rows lower:
    the slope of row error over row flow is the skew.

    Args:
        row_error_px: float64 (N,), right minus left row, with the rig's own row error removed.
        row_flow_px: float64 (N,), rows that each feature moves from this frame to the next.

    Returns:
        The skew and its standard error, in frames; None if too few features move enough.
    """
    moving = np.abs(row_flow_px) > _MIN_FLOW_PX
    if moving.sum() < _MIN_POINTS:
        return None
    flow, error = row_flow_px[moving], row_error_px[moving]
    weight = np.ones(len(flow))
    slope = 0.0
    for _ in range(10):
        slope = float(np.sum(weight * flow * error) / np.sum(weight * flow * flow))
        residual = error - slope * flow
        scale = 1.4826 * float(np.median(np.abs(residual))) + 1e-3
        weight = np.where(np.abs(residual) < 3 * scale, 1.0, 0.0)
    kept = weight > 0
    variance = float(np.mean((error - slope * flow)[kept] ** 2)) / float(np.sum(flow[kept] ** 2))
    return slope, float(np.sqrt(variance))
