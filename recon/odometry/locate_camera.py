"""The pose of one frame: predicted by the last motion, and found from known points that it sees."""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import Final

import cv2
import numpy as np

from recon.core.geometry.se3 import apply, exp_so3, invert, log_so3, make_transform, orthonormalise
from recon.core.values import RectifiedCamera
from recon.core.values.arrays import Bool, Float64
from recon.core.values.camera import project

REPROJECTION_PX: Final = 2.0  # RANSAC's inlier limit
_ITERATIONS: Final = 200  # RANSAC's samples at most
MIN_INLIERS: Final = 15  # fewer agreeing tracks give no pose
_MIN_INLIER_SHARE: Final = 0.3  # a smaller share of agreeing tracks gives no pose


def locate_camera(
    xyz_world: Float64,
    uv: Float64,
    camera: RectifiedCamera,
    T_world_guess: Float64,
) -> LocatedCamera | None:
    """Locate a camera that sees known points, from the largest set of them that agrees.

    The pose is fitted to that set from the guess and from RANSAC's pose; the fit with more inliers
    wins. None where too few points agree on one.
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
    """Whether so many of the tracks agree that the pose counts as measured."""
    return agreeing >= max(MIN_INLIERS, _MIN_INLIER_SHARE * tracks)


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


@dataclass(frozen=True, eq=False)
class LocatedCamera:
    """The pose of a camera, from known points."""

    T_world_camera: Float64  # (4, 4)
    agree: Bool  # (N,), True for the points that agree with it


def find_consensus(
    xyz_world: Float64,
    uv: Float64,
    camera: RectifiedCamera,
    *,
    limit_px: float,
    iterations: int,
    min_inliers: int,
) -> LocatedCamera | None:
    """Find the largest set of points (N, 3), seen at (N, 2), that agree on one pose (RANSAC).

    The pose that comes with it is a closed-form fit (EPnP) that one point near the horizon throws
    off by metres or kilometres: fit it again with `fit_pose`. RANSAC seeds its own generator, so
    equal input gives equal output.

    Ref: Fischler and Bolles, "Random sample consensus", CACM 1981.
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

    From an initial pose, or else in closed form from the points.
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
    """T_world_camera from OpenCV's rotation vector and translation."""
    R, _ = cv2.Rodrigues(rotation)
    return invert(make_transform(R, translation))


_LONGEST_GAP: Final = 20.0
"""In intervals: over a longer gap the motion is not extrapolated in time, but repeated once."""


@dataclass(frozen=True, eq=False)
class Motion:
    """The last pose, and how the camera moved to it."""

    T_world_camera: Float64  # (4, 4), the last pose
    timestamp_s: float  # time of the last pose
    # float64 (4, 4), the motion to it
    T_before_camera: Float64 = field(default_factory=lambda: np.eye(4))
    interval_s: float = 0.0  # time that the motion took; 0 = not known

    def predict(self, timestamp_s: float) -> Float64:
        """The pose (4, 4) at a time: with constant velocity, where times are known."""
        passed_s = timestamp_s - self.timestamp_s
        share = passed_s / self.interval_s if self.interval_s > 0.0 else 1.0
        if not 0.0 < share <= _LONGEST_GAP:
            share = 1.0
        return orthonormalise(self.T_world_camera @ part_of(self.T_before_camera, share))

    def moved(self, T_world_camera: Float64, timestamp_s: float) -> Motion:
        """The model after a measured pose, which gives a new motion."""
        motion = invert(self.T_world_camera) @ T_world_camera
        return Motion(T_world_camera, timestamp_s, motion, timestamp_s - self.timestamp_s)

    def drifted(self, timestamp_s: float) -> Motion:
        """The model after a frame without a measured pose: the same motion continues."""
        T = self.predict(timestamp_s)
        return Motion(T, timestamp_s, self.T_before_camera, self.interval_s)


def part_of(T: Float64, share: float) -> Float64:
    """A fraction or multiple of a motion (4, 4): rotation and translation in proportion."""
    if share == 1.0:
        return T
    return make_transform(exp_so3(share * log_so3(T[:3, :3])), share * T[:3, 3])
