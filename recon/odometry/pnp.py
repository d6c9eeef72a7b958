"""Perspective-n-point: the pose of a camera that sees known points, some of them wrongly."""

from __future__ import annotations

from dataclasses import dataclass

import cv2
import numpy as np

from recon.core.geometry.se3 import invert, make_transform
from recon.core.values import RectifiedCamera
from recon.core.values.arrays import Bool, Float64


@dataclass(frozen=True, eq=False)
class LocatedCamera:
    """The pose of a camera, from known points.

    Attributes:
        T_world_camera: float64 (4, 4).
        agree: bool (N,), True for the points that agree with it.
    """

    T_world_camera: Float64
    agree: Bool


def find_consensus(
    xyz_world: Float64,
    uv: Float64,
    camera: RectifiedCamera,
    *,
    limit_px: float,
    iterations: int,
    min_inliers: int,
) -> LocatedCamera | None:
    """Find the largest set of points that agree on one pose (RANSAC).

    The pose that comes with it is a closed-form fit (EPnP) that one point near the horizon throws
    off by metres or kilometres: fit it again with `fit_pose`. RANSAC seeds its own generator, so
    equal input gives equal output.

    Args:
        xyz_world: float64 (N, 3), the points.
        uv: float64 (N, 2), where the camera sees them.
        camera: The rectified camera.
        limit_px: Largest reprojection error of a point that agrees.
        iterations: Samples at most.
        min_inliers: Fewer points that agree give no pose.

    Ref:
        Fischler and Bolles, "Random sample consensus", CACM 1981.
    """
    if len(xyz_world) < min_inliers:
        return None
    found, rotation, translation, inliers = cv2.solvePnPRansac(
        xyz_world,
        uv,
        camera.matrix,
        None,
        iterationsCount=iterations,
        reprojectionError=limit_px,
        confidence=0.999,
        flags=cv2.SOLVEPNP_AP3P,
    )
    # Four points give a closed-form pose anyhow; the fit that follows needs more.
    if not found or inliers is None or len(inliers) < min_inliers:
        return None
    agree = np.zeros(len(xyz_world), np.bool_)
    agree[inliers.reshape(-1)] = True
    return LocatedCamera(_pose(rotation, translation), agree)


def fit_pose(
    xyz_world: Float64, uv: Float64, camera: RectifiedCamera, T_world_start: Float64 | None = None
) -> Float64:
    """Fit the pose (4, 4) of least squared reprojection error (Levenberg-Marquardt).

    Args:
        xyz_world: float64 (N, 3), points that agree.
        uv: float64 (N, 2), where the camera sees them.
        camera: The rectified camera.
        T_world_start: float64 (4, 4), initial pose; None = in closed form from the points.
    """
    if T_world_start is None:
        _, rotation, translation = cv2.solvePnP(
            xyz_world, uv, camera.matrix, None, flags=cv2.SOLVEPNP_SQPNP
        )
    else:
        T_camera_world = invert(T_world_start)
        rotation, _ = cv2.Rodrigues(T_camera_world[:3, :3])
        translation = T_camera_world[:3, 3].reshape(3, 1).copy()
    rotation, translation = cv2.solvePnPRefineLM(
        xyz_world, uv, camera.matrix, None, rotation, translation
    )
    return _pose(rotation, translation)


def _pose(rotation: Float64, translation: Float64) -> Float64:
    """Return T_world_camera from OpenCV's rotation vector and translation."""
    R, _ = cv2.Rodrigues(rotation)
    return invert(make_transform(R, translation))
