"""kiss-icp on the points that stereo measures well: as an odometry, and in a map that is there."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass, replace
from typing import Any, Final

import cv2
import numpy as np
from kiss_icp.config import KISSConfig
from kiss_icp.config.config import DataConfig, MappingConfig, RegistrationConfig
from kiss_icp.kiss_icp import KissICP
from numpy.typing import NDArray

from recon.core.errors import RegistrationError
from recon.core.geometry.se3 import invert, orthonormalise
from recon.core.text import counted
from recon.core.values import Disparity, PointCloud
from recon.core.values.arrays import Bool, Float64, UInt8
from recon.core.values.camera import depth_from_disparity, depth_sigma, unproject
from recon.odometry.protocol import OdometryFrame, OdometryHealth, OdometryResult, pose_in
from recon.odometry.visual import VisualOdometry

RANGE_M: Final = 30.0  # on a road: farther points are not registered, stereo places them badly
_RANGE_IN_VOXELS: Final = 100.0
"""Range relative to the edge of a voxel, by kiss-icp's own rule. Of 30 m this gives 0.3 m: points
are as uncertain, and with 0.2 m paths are the same and take twice the time."""

_BEYOND: Final = 2.0
"""How far the map reaches, and how uncertain its points may be, relative to those registered. At
the rim of the map new points would find older ones before them nearest, and hold the camera back.
"""

_RANGE: Final = 30.0  # relative to the nearest points used, and to the largest standard deviation
_STILL: Final = 1e-4  # step of ICP that is its last one, relative to the same
_MIN_POINTS: Final = 300  # frames with fewer points are not registered


class KissOdometry:
    """Registers points in a map of those before, from where visual odometry sees the camera.

    The guess makes frames meet, and registration decides: guesses off by 0.1 m in any direction
    give the same path. With every point, as of a LiDAR, motion is underestimated (`select_points`).

    Args:
        max_range_m: Farther points are not registered.
        visual: Gives the guess.
    """

    def __init__(self, max_range_m: float, visual: VisualOdometry) -> None:
        self._max_range_m, self._visual = max_range_m, visual
        voxel_m = max_range_m / _RANGE_IN_VOXELS
        # Points of the map are half a voxel apart. What is off by more is another place.
        self._threshold_m = 0.5 * voxel_m
        still = _STILL * max_range_m / _RANGE
        self._icp = KissIcp(_BEYOND * max_range_m, voxel_m, convergence=still)
        self._T_world_camera = self._T_visual = np.eye(4)

    def register(self, frame: OdometryFrame) -> OdometryResult:
        """Register the next frame; one with too few points goes where visual odometry says."""
        seen = self._visual.register(frame)
        guess = self._T_world_camera @ invert(self._T_visual) @ seen.T_world_camera
        self._T_visual = seen.T_world_camera
        points, range_m = select_points(frame, self._max_range_m, _BEYOND), self._max_range_m
        sigma_m = np.asarray(points.sigma_m)
        near = (points.xyz[:, 2] <= range_m) & (sigma_m <= range_m / _RANGE)
        source, visual_m = points.xyz[near], tuple(seen.T_world_camera[:3, 3].tolist())
        health = OdometryHealth(icp_points=len(source), visual_m=visual_m)
        if len(source) < _MIN_POINTS:
            note = f"too few for ICP: {counted(len(source), 'point')}; the visual motion goes on"
            notes = (note, *seen.health.notes)
            health = replace(seen.health, icp_points=len(source), visual_m=visual_m, notes=notes)
            self._T_world_camera = orthonormalise(guess)
        else:
            # kiss-icp weighs by the ratio of its kernel to the square of a distance.
            kernel_m2 = self._threshold_m**2
            alignment = self._icp.align(source, guess, self._threshold_m, kernel_m2)
            self._T_world_camera = alignment.T_world_camera
            self._icp.add(points.xyz, self._T_world_camera)
        return OdometryResult(self._T_world_camera, health)

    def state(self) -> dict[str, Any]:
        return {
            "visual": self._visual.state(),
            "points": self._icp.points(),
            "T_world_camera": self._T_world_camera,
            "T_visual": self._T_visual,
        }

    def restore(self, state: dict[str, Any]) -> None:
        self._visual.restore(state["visual"])
        self._icp.set_map(state["points"])
        self._T_world_camera, self._T_visual = (
            pose_in(state, name) for name in ("T_world_camera", "T_visual")
        )


_POINTS_PER_VOXEL: Final = 20  # most points that a voxel of the map keeps


@dataclass(frozen=True, eq=False)
class IcpAlignment:
    """Result of ICP for one frame."""

    T_world_camera: Float64  # (4, 4), the aligned pose
    source: Float64  # (N, 3), the points used for alignment, camera axes


class KissIcp:
    """kiss-icp and its local map.

    Points are in OpenCV's camera axes, poses are those of the camera. It runs in one thread, so
    that sums have a fixed order and equal input gives equal output.

    Args:
        max_range_m: Points farther from the sensor are dropped, and the map is clipped there.
        voxel_m: Edge of a voxel of the map.
        iterations: Of ICP, at most.
        convergence: Length of a step that is the last.
    """

    def __init__(
        self,
        max_range_m: float,
        voxel_m: float,
        *,
        iterations: int = 500,
        convergence: float = _STILL,
    ) -> None:
        # `model_construct` ignores environment variables.
        config = KISSConfig.model_construct(
            out_dir="",
            data=DataConfig(max_range=max_range_m, min_range=0.0, deskew=False),
            registration=RegistrationConfig(
                max_num_iterations=iterations, convergence_criterion=convergence, max_num_threads=1
            ),
            mapping=MappingConfig(voxel_size=voxel_m, max_points_per_voxel=_POINTS_PER_VOXEL),
        )
        with _our_errors():
            self._icp = KissICP(config)

    def align(
        self,
        xyz_camera: NDArray[np.floating],
        T_world_guess: NDArray[np.floating],
        threshold_m: float,
        kernel_m2: float,
    ) -> IcpAlignment:
        """Align points (N, 3) to the map from a guess of the pose, without changing the map.

        Correspondences are at most three times ``threshold_m`` long; one whose square is
        ``kernel_m2`` counts a quarter.
        """
        points = _points(xyz_camera)
        guess, icp = _pose(T_world_guess), self._icp
        with _our_errors():
            near = icp.preprocessor.preprocess(points, np.zeros(0), np.eye(4))
            source, _ = icp.voxelize(near)
            if not len(source) or icp.local_map.empty():
                return IcpAlignment(guess, np.array(source))
            pose = icp.registration.align_points_to_map(
                points=source,
                voxel_map=icp.local_map,
                initial_guess=guess,
                max_correspondance_distance=3 * threshold_m,
                kernel=kernel_m2,
            )
        return IcpAlignment(_pose(pose), np.array(source))

    def set_map(self, xyz_world: NDArray[np.floating]) -> None:
        """Replace the map by points (M, 3), of which there may be none."""
        with _our_errors():
            self._icp.local_map.clear()
            if len(xyz_world):
                self._icp.local_map.add_points(_points(xyz_world))

    def add(self, xyz_camera: NDArray[np.floating], T_world_camera: Float64) -> None:
        """Add points (N, 3) of a frame to the map, and forget those out of its range."""
        with _our_errors():
            _, points = self._icp.voxelize(_points(xyz_camera))
            self._icp.local_map.update(points, T_world_camera)

    def points(self) -> Float64:
        """The points (M, 3) of the map, of which an equal one can be made."""
        return np.array(self._icp.local_map.point_cloud(), np.float64).reshape(-1, 3)


def _points(xyz: NDArray[np.floating]) -> Float64:
    """Check points and make a writable float64 copy (kiss-icp rejects read-only arrays)."""
    points = np.array(xyz, dtype=np.float64)
    if points.ndim != 2 or points.shape[1] != 3 or not len(points):
        # kiss-icp accepts an empty frame silently, but changes its pose.
        raise RegistrationError("no points to register", got=points.shape, expected="(N, 3)")
    if not np.isfinite(points).all():
        raise RegistrationError("points to register are not finite")
    return points


def _pose(T: NDArray[np.floating]) -> Float64:
    """A writable orthonormal copy: kiss-icp aborts the process if the rotation is not."""
    pose = np.array(T, dtype=np.float64)
    if pose.shape != (4, 4) or not np.isfinite(pose).all():
        raise RegistrationError("pose for ICP is not a finite 4x4 matrix", got=pose.shape)
    return orthonormalise(pose)


@contextmanager
def _our_errors() -> Iterator[None]:
    try:
        yield
    except (ValueError, TypeError, RuntimeError, MemoryError, ArithmeticError) as error:
        raise RegistrationError("kiss-icp failed", got=str(error)) from error


_MIN_GRADIENT: Final = 100.0  # least horizontal gradient, 3x3 Sobel of grey values
_MAX_DISPARITY_STEP_PX: Final = 0.5
"""Largest difference between a disparity and the median around it."""


def select_points(frame: OdometryFrame, max_range_m: float, beyond: float = 1.0) -> PointCloud:
    """Near, textured points (camera axes) whose disparity agrees with its neighbours.

    Those ``beyond`` times as far away, and as uncertain, as the range allows are among them.

    Dense stereo clouds are smeared along the rays where there is little texture, and extend the
    ground towards the camera; ICP on all points underestimates forward motion.
    """
    camera = frame.pair.camera
    depth = depth_from_disparity(frame.disparity.values, camera)
    sigma = depth_sigma(depth, frame.disparity.sigma_px, camera)
    with np.errstate(invalid="ignore"):
        good = (depth >= max_range_m / _RANGE) & (depth <= beyond * max_range_m)
        good &= sigma <= beyond * max_range_m / _RANGE
    good &= textured(frame.pair.left, _MIN_GRADIENT)
    good &= consistent(frame.disparity, _MAX_DISPARITY_STEP_PX)
    v, u = np.nonzero(good)
    xyz = unproject(u, v, depth[good], camera)
    return PointCloud(xyz=xyz, sigma_m=sigma[good], frame="camera")


def textured(grey: UInt8, min_gradient: float) -> Bool:
    """Where the image (H, W) changes along the row: only that fixes a disparity."""
    gradient = cv2.Sobel(grey, cv2.CV_32F, 1, 0, ksize=3)
    return np.asarray(np.abs(gradient) > min_gradient)


def consistent(disparity: Disparity, max_step_px: float) -> Bool:
    """Where a disparity (H, W) is close to the median of its 5×5 neighbours.

    Pixels without a match count as far away, so the rims of matched regions fall out too.
    """
    values = np.where(disparity.valid, disparity.values, np.float32(-1e6)).astype(np.float32)
    return np.asarray(disparity.valid & (np.abs(cv2.medianBlur(values, 5) - values) <= max_step_px))
