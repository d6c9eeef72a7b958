"""kiss-icp: as an odometry, on the points that stereo measures well; and in a map that is there."""

from __future__ import annotations

import math
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from typing import Any, Final

import cv2
import numpy as np
from kiss_icp.config import KISSConfig
from kiss_icp.config.config import (
    AdaptiveThresholdConfig,
    DataConfig,
    MappingConfig,
    RegistrationConfig,
)
from kiss_icp.kiss_icp import KissICP
from numpy.typing import NDArray

from recon.core.errors import RegistrationError
from recon.core.geometry.se3 import angle_rad, invert, orthonormalise
from recon.core.text import counted
from recon.core.values import Disparity, PointCloud
from recon.core.values.arrays import Bool, Float32, Float64, UInt8
from recon.core.values.camera import depth_from_disparity, depth_sigma, unproject
from recon.odometry.protocol import OdometryFrame, OdometryHealth, OdometryResult, pose_in

_VOXEL_M: Final = 0.2  # edge of a voxel of the map
_MIN_POINTS: Final = 300  # frames with fewer points are skipped


class KissOdometry:
    """Gives kiss-icp the points that stereo measures well; it has a motion model of its own.

    With every point, as of a LiDAR, it underestimates motion by half (`select_points`).

    Args:
        max_range_m: Farther points are not used.
    """

    def __init__(self, max_range_m: float) -> None:
        self._max_range_m = max_range_m
        self._icp = KissIcp(KissIcpOptions(max_range_m, _VOXEL_M))
        self._poses: list[Float64] = []

    def register(self, frame: OdometryFrame) -> OdometryResult:
        """Register the next frame; one with too few points is extrapolated."""
        points = select_points(frame, self._max_range_m)
        if len(points) < _MIN_POINTS:
            note = f"too few for ICP: {counted(len(points), 'point')}; the last motion goes on"
            first = not self._poses
            health = OdometryHealth(first, skipped=not first, icp_points=len(points), notes=(note,))
            return self._keep(self._extrapolated(), health)
        alignment = self._icp.register(points.xyz)
        health = OdometryHealth(icp_points=len(alignment.source))
        return self._keep(alignment.T_world_camera, health)

    def state(self) -> dict[str, Any]:
        return {"icp": self._icp.state(), "poses": [{"T": pose} for pose in self._poses]}

    def restore(self, state: dict[str, Any]) -> None:
        self._icp.restore(state["icp"])
        self._poses = [pose_in(pose, "T") for pose in state["poses"]]

    def _keep(self, T_world_camera: Float64, health: OdometryHealth) -> OdometryResult:
        self._poses = [*self._poses[-1:], T_world_camera]
        return OdometryResult(T_world_camera, health)

    def _extrapolated(self) -> Float64:
        """The last pose, moved by the last motion."""
        if len(self._poses) < 2:
            return self._poses[-1] if self._poses else np.eye(4)
        before, last = self._poses
        return np.asarray(last @ invert(before) @ last)


_POINTS_PER_VOXEL: Final = 20  # most points that a voxel of the map keeps
_INITIAL_THRESHOLD_M: Final = 2.0  # first value of the adaptive threshold
_MIN_MOTION_M: Final = 0.1  # smaller deviations from the motion model do not change the threshold


@dataclass(frozen=True)
class KissIcpOptions:
    """What users of kiss-icp choose."""

    max_range_m: float  # points farther from the sensor are dropped, and the map is clipped there
    voxel_m: float  # voxel size of the map
    iterations: int = 500  # maximum number of ICP iterations
    convergence: float = 1e-4  # step length below which ICP has converged


@dataclass(frozen=True, eq=False)
class IcpAlignment:
    """Result of ICP for one frame."""

    T_world_camera: Float64  # (4, 4), the aligned pose
    source: Float64  # (N, 3), the points used for alignment, camera axes


class KissIcp:
    """kiss-icp and its local map.

    Points are in OpenCV's camera axes, poses are those of the camera. It runs in one thread, so
    that sums have a fixed order and equal input gives equal output.
    """

    def __init__(self, options: KissIcpOptions) -> None:
        self._options = options
        self._icp = _new(options)

    def register(self, xyz_camera: NDArray[np.floating]) -> IcpAlignment:
        """Register points (N, 3) with kiss-icp's own motion model, threshold and map update."""
        points = _points(xyz_camera)
        with _our_errors():
            _, source = self._icp.register_frame(points, np.zeros(0))
        return IcpAlignment(_pose(self._icp.last_pose), np.array(source))

    def align(
        self,
        xyz_camera: NDArray[np.floating],
        T_world_guess: NDArray[np.floating],
        threshold_m: float,
    ) -> IcpAlignment:
        """Align points (N, 3) to the map from a guess of the pose, without changing the map.

        ``threshold_m`` is the scale of the robust kernel; correspondences are at most three times
        as far.
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
                kernel=threshold_m,
            )
        return IcpAlignment(_pose(pose), np.array(source))

    def set_map(self, xyz_world: NDArray[np.floating]) -> None:
        """Replace the map by points (M, 3), of which there may be none."""
        with _our_errors():
            self._icp.local_map.clear()
            if len(xyz_world):
                self._icp.local_map.add_points(_points(xyz_world))

    def state(self) -> dict[str, Any]:
        """Return everything that later results depend on, as arrays and plain values."""
        icp = self._icp
        return {
            "points": np.array(icp.local_map.point_cloud(), dtype=np.float64).reshape(-1, 3),
            "last_pose": np.array(icp.last_pose),
            "last_delta": np.array(icp.last_delta),
            "threshold": icp.adaptive_threshold.state(),
        }

    def restore(self, state: dict[str, Any]) -> None:
        """Continue from a `state` of the same options."""
        poses = [state[name] for name in ("last_pose", "last_delta")]
        for pose in poses:
            _pose(pose)
        self._icp = _new(self._options)
        with _our_errors():
            if len(state["points"]):
                self._icp.local_map.add_points(_points(state["points"]))
        self._icp.last_pose, self._icp.last_delta = poses
        self._icp.adaptive_threshold.restore(state["threshold"])


class _AdaptiveThreshold:
    """kiss-icp's adaptive threshold: rms error of the motion model. The state of its own is hidden.

    Ref:
        Vizzo et al., "KISS-ICP: in defense of point-to-point ICP", RA-L 2023, section III-C.
    """

    def __init__(self, max_range_m: float) -> None:
        self._max_range_m = max_range_m
        self._sum_m2 = _INITIAL_THRESHOLD_M**2
        self._count = 1

    def get_threshold(self) -> float:
        """The root mean square of the deviations so far, metres."""
        return math.sqrt(self._sum_m2 / self._count)

    def update_model_deviation(self, model_deviation: Float64) -> None:
        """Count one more deviation, a transform (4, 4)."""
        turn_m = 2.0 * self._max_range_m * math.sin(0.5 * float(angle_rad(model_deviation)))
        error_m = turn_m + float(np.linalg.norm(model_deviation[:3, 3]))
        if error_m > _MIN_MOTION_M:
            self._sum_m2 += error_m**2
            self._count += 1

    def state(self) -> list[float]:
        """Sum of the squared deviations, and their number."""
        return [self._sum_m2, self._count]

    def restore(self, state: list[float]) -> None:
        """Continue from a `state`."""
        sum_m2, count = state
        if not (math.isfinite(sum_m2) and sum_m2 >= 0 and count >= 1):
            raise RegistrationError("threshold of ICP is damaged", got=state)
        self._sum_m2, self._count = float(sum_m2), int(count)


def _new(options: KissIcpOptions) -> KissICP:
    """kiss-icp with an empty map, and a threshold of which the state can be saved."""
    with _our_errors():
        icp = KissICP(_config(options))
    icp.adaptive_threshold = _AdaptiveThreshold(options.max_range_m)
    return icp


def _config(options: KissIcpOptions) -> KISSConfig:
    """Its configuration; ``model_construct`` ignores environment variables."""
    return KISSConfig.model_construct(
        out_dir="",
        data=DataConfig(max_range=options.max_range_m, min_range=0.0, deskew=False),
        registration=RegistrationConfig(
            max_num_iterations=options.iterations,
            convergence_criterion=options.convergence,
            max_num_threads=1,
        ),
        mapping=MappingConfig(voxel_size=options.voxel_m, max_points_per_voxel=_POINTS_PER_VOXEL),
        adaptive_threshold=AdaptiveThresholdConfig(
            fixed_threshold=None,
            initial_threshold=_INITIAL_THRESHOLD_M,
            min_motion_th=_MIN_MOTION_M,
        ),
    )


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

_MIN_RANGE_M: Final = 1.0  # nearer points are not used
_MAX_SIGMA_M: Final = 1.0  # points with a less certain depth are not used


def select_points(frame: OdometryFrame, max_range_m: float) -> PointCloud:
    """Near, textured points (camera axes) whose disparity agrees with its neighbours.

    Dense stereo clouds are smeared along the rays where there is little texture, and extend the
    ground towards the camera; ICP on all points underestimates forward motion.
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
    """Where the image (H, W) changes along the row: only that fixes a disparity."""
    gradient = cv2.Sobel(grey, cv2.CV_32F, 1, 0, ksize=3)
    return np.asarray(np.abs(gradient) > min_gradient)


def consistent(disparity: Disparity, max_step_px: float) -> Bool:
    """Where a disparity (H, W) is close to the median of its 5×5 neighbours.

    Pixels without a match count as far away, so the rims of matched regions fall out too.
    """
    values = np.where(disparity.valid, disparity.values, np.float32(-1e6)).astype(np.float32)
    return np.asarray(disparity.valid & (np.abs(cv2.medianBlur(values, 5) - values) <= max_step_px))


def _cloud(frame: OdometryFrame, depth: Float32, sigma: Float32, where: Bool) -> PointCloud:
    v, u = np.nonzero(where)
    xyz = unproject(u, v, depth[where], frame.pair.camera)
    return PointCloud(xyz=xyz, sigma_m=sigma[where], frame="camera")
