"""The pose of one frame from points whose places are known."""

from __future__ import annotations

from dataclasses import dataclass

import cv2
import numpy as np

from recon.geometry.se3 import invert, make_transform
from recon.odometry.settings import PoseSettings
from recon.structures import RectifiedCamera
from recon.structures.arrays import Bool, Float64


@dataclass(frozen=True, eq=False)
class LocatedCamera:
    """Where a camera stands, by points whose places are known.

    Attributes:
        T_world_camera: float64 (4, 4).
        agree: bool (N,), True for the points that agree with it.
    """

    T_world_camera: Float64
    agree: Bool


def locate_camera(
    xyz_world: Float64, uv: Float64, camera: RectifiedCamera, settings: PoseSettings
) -> LocatedCamera | None:
    """Where a camera stands that sees known points, by the largest set that agrees.

    OpenCV's RANSAC seeds its own generator, so equal input gives equal output.

    Args:
        xyz_world: float64 (N, 3), the points.
        uv: float64 (N, 2), where the camera sees them.
        camera: The rectified camera.
        settings: Tolerance, samples, and how many must agree.

    Returns:
        The pose; None where too few points agree on one.

    Ref:
        Fischler and Bolles, "Random sample consensus", CACM 1981.
    """
    if len(xyz_world) < settings.min_inliers:
        return None
    found, rotation, translation, inliers = cv2.solvePnPRansac(
        xyz_world,
        uv,
        camera.matrix,
        None,
        iterationsCount=settings.iterations,
        reprojectionError=settings.reprojection_px,
        confidence=0.999,
        flags=cv2.SOLVEPNP_AP3P,
    )
    if not found or inliers is None:
        return None
    agree = np.zeros(len(xyz_world), np.bool_)
    agree[inliers.reshape(-1)] = True
    enough = max(settings.min_inliers, settings.min_inlier_share * len(xyz_world))
    if agree.sum() < enough or not np.isfinite(translation).all():
        return None
    R, _ = cv2.Rodrigues(rotation)
    return LocatedCamera(invert(make_transform(R, translation)), agree)
