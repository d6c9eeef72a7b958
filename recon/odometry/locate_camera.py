"""The pose of one frame from tracks of known points."""

from __future__ import annotations

from typing import Final

import numpy as np

from recon.core.geometry.projection import project
from recon.core.geometry.se3 import apply, invert
from recon.core.values import RectifiedCamera
from recon.core.values.arrays import Float64
from recon.odometry.pnp import LocatedCamera, find_consensus, fit_pose

REPROJECTION_PX: Final = 2.0
"""RANSAC's inlier limit."""

_ITERATIONS: Final = 200
"""RANSAC's samples at most."""

MIN_INLIERS: Final = 15
"""Fewer agreeing tracks give no pose."""

_MIN_INLIER_SHARE: Final = 0.3
"""A smaller share of agreeing tracks gives no pose."""


def locate_camera(
    xyz_world: Float64,
    uv: Float64,
    camera: RectifiedCamera,
    T_world_guess: Float64,
) -> LocatedCamera | None:
    """Locate a camera that sees known points, from the largest set of them that agrees.

    The pose is fitted to that set from the guess and from RANSAC's pose; the fit with more inliers
    wins.

    Args:
        xyz_world: float64 (N, 3), the points.
        uv: float64 (N, 2), where the camera sees them.
        camera: The rectified camera.
        T_world_guess: float64 (4, 4), the predicted pose.

    Returns:
        The pose; None where too few points agree on one.
    """
    consensus = find_consensus(
        xyz_world,
        uv,
        camera,
        limit_px=REPROJECTION_PX,
        iterations=_ITERATIONS,
        min_inliers=MIN_INLIERS,
    )
    if consensus is None:
        return None
    among = consensus.agree
    fits = [
        _agreement(fit_pose(xyz_world[among], uv[among], camera, T), xyz_world, uv, camera)
        for T in (T_world_guess, consensus.T_world_camera)
    ]
    best = max(fits, key=lambda fit: int(fit.agree.sum()))
    return best if enough_agree(int(best.agree.sum()), len(xyz_world)) else None


def enough_agree(agreeing: int, tracks: int) -> bool:
    """Return whether so many of the tracks agree that the pose counts as measured."""
    return agreeing >= max(MIN_INLIERS, _MIN_INLIER_SHARE * tracks)


def _agreement(
    T_world_camera: Float64,
    xyz_world: Float64,
    uv: Float64,
    camera: RectifiedCamera,
) -> LocatedCamera:
    """Return which points agree with a pose; none, where it is not finite."""
    u, v, _ = project(apply(invert(T_world_camera), xyz_world), camera)
    error_px = np.hypot(u - uv[:, 0], v - uv[:, 1])
    # A point behind the camera has a NaN error, which compares as False.
    return LocatedCamera(T_world_camera, np.asarray(error_px <= REPROJECTION_PX))
