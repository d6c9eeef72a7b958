"""The pose of one frame from known points (perspective-n-point)."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Final

import cv2
import numpy as np

from recon.core.geometry.projection import project
from recon.core.geometry.se3 import apply, invert, make_transform
from recon.core.values import RectifiedCamera
from recon.core.values.arrays import Bool, Float64

REPROJECTION_PX: Final = 2.0
"""RANSAC's inlier limit."""

_ITERATIONS: Final = 200
"""RANSAC's samples at most."""

MIN_INLIERS: Final = 15
"""Fewer agreeing tracks give no pose."""

_MIN_INLIER_SHARE: Final = 0.3
"""A smaller share of agreeing tracks gives no pose."""


@dataclass(frozen=True, eq=False)
class LocatedCamera:
    """The pose of a camera, from known points.

    Attributes:
        T_world_camera: float64 (4, 4).
        agree: bool (N,), True for the points that agree with it.
    """

    T_world_camera: Float64
    agree: Bool


def locate_camera(
    xyz_world: Float64,
    uv: Float64,
    camera: RectifiedCamera,
    T_world_guess: Float64,
) -> LocatedCamera | None:
    """The pose of a camera that sees known points, from the largest set of them that agrees.

    OpenCV's RANSAC finds that set well, but its pose is a closed-form fit (EPnP) that one point
    near the horizon throws off by metres or kilometres. So only the set is used: the pose is fitted
    to it again, from the guess and from RANSAC's pose, and the fit with more inliers wins. RANSAC
    seeds its own generator, so equal input gives equal output.

    Args:
        xyz_world: float64 (N, 3), the points.
        uv: float64 (N, 2), where the camera sees them.
        camera: The rectified camera.
        T_world_guess: float64 (4, 4), the predicted pose.

    Returns:
        The pose; None where too few points agree on one.

    Ref:
        Fischler and Bolles, "Random sample consensus", CACM 1981.
    """
    if len(xyz_world) < MIN_INLIERS:
        return None
    consensus = _ransac(xyz_world, uv, camera)
    if consensus is None:
        return None
    among = consensus.agree
    fits = [
        _agreement(_fit(xyz_world[among], uv[among], camera, T), xyz_world, uv, camera)
        for T in (T_world_guess, consensus.T_world_camera)
    ]
    best = max(fits, key=lambda fit: int(fit.agree.sum()))
    return best if enough_agree(int(best.agree.sum()), len(xyz_world)) else None


def enough_agree(agreeing: int, tracks: int) -> bool:
    """Whether so many of the tracks agree that the pose counts as measured."""
    return agreeing >= max(MIN_INLIERS, _MIN_INLIER_SHARE * tracks)


def _ransac(xyz_world: Float64, uv: Float64, camera: RectifiedCamera) -> LocatedCamera | None:
    """The largest set that agrees, and a rough pose."""
    found, rotation, translation, inliers = cv2.solvePnPRansac(
        xyz_world,
        uv,
        camera.matrix,
        None,
        iterationsCount=_ITERATIONS,
        reprojectionError=REPROJECTION_PX,
        confidence=0.999,
        flags=cv2.SOLVEPNP_AP3P,
    )
    # Four points give a closed-form pose anyhow; the fit that follows needs more.
    if not found or inliers is None or len(inliers) < MIN_INLIERS:
        return None
    agree = np.zeros(len(xyz_world), np.bool_)
    agree[inliers.reshape(-1)] = True
    return LocatedCamera(_pose(rotation, translation), agree)


def _fit(
    xyz_world: Float64, uv: Float64, camera: RectifiedCamera, T_world_start: Float64
) -> Float64:
    """The pose (4, 4) of least squared reprojection error near a start."""
    T_camera_world = invert(T_world_start)
    rotation, _ = cv2.Rodrigues(T_camera_world[:3, :3])
    translation = T_camera_world[:3, 3].reshape(3, 1).copy()
    rotation, translation = cv2.solvePnPRefineLM(
        xyz_world, uv, camera.matrix, None, rotation, translation
    )
    return _pose(rotation, translation)


def _agreement(
    T_world_camera: Float64,
    xyz_world: Float64,
    uv: Float64,
    camera: RectifiedCamera,
) -> LocatedCamera:
    """Which points agree with a pose; none, where it is not finite."""
    u, v, _ = project(apply(invert(T_world_camera), xyz_world), camera)
    error_px = np.hypot(u - uv[:, 0], v - uv[:, 1])
    # A point behind the camera has a NaN error, which compares as False.
    return LocatedCamera(T_world_camera, np.asarray(error_px <= REPROJECTION_PX))


def _pose(rotation: Float64, translation: Float64) -> Float64:
    """T_world_camera from OpenCV's rotation vector and translation."""
    R, _ = cv2.Rodrigues(rotation)
    return invert(make_transform(R, translation))
