"""The odometry of a drive: one of ours, perhaps guided by other sensors, or known poses."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field, replace
from typing import Final

import numpy as np

from recon.core.errors import ReconError, RegistrationError
from recon.core.geometry.se3 import make_transform
from recon.core.text import counted
from recon.core.values import Trajectory
from recon.map.settings import DriveSettings
from recon.odometry.arriving import ArrivingGyro, ArrivingPath
from recon.odometry.guide import Guide
from recon.odometry.imu import seen_runs
from recon.odometry.imu_fit import FittedImu, fit_imu
from recon.odometry.prior import MotionPrior, find_axes, first_moving
from recon.odometry.protocol import Odometry, OdometryFrame
from recon.odometry.registry import KnownPoses, make_odometry
from recon.odometry.settings import PriorSettings
from recon.sources.source import Mount, StereoSource
from recon.stereo.frame import FrameReconstructor
from recon.stereo.rectify.rectifier import RectificationSettings, turns_of

_KNOWN: Final = PriorSettings(sigma_ratio=0.01)
"""How well poses are expected to be known; only where they are much worse is it said."""


@dataclass(frozen=True)
class UsedPrior:
    """How an external trajectory was used: its axes, known from images, settings, or assumed.

    ``sigmas`` are median distances from the visual motion in each set of axes, in standard
    deviations.
    """

    axes: str
    known_from: str
    sigmas: Mapping[str, float] = field(default_factory=dict)

    def warnings(self) -> list[str]:
        if self.known_from != "assumed":
            return []
        what = "too little motion was seen to tell the axes of the prior"
        return [f"{what}; taken as those of the camera (odometry.prior.axes)"]


def axes_of(
    prior: Trajectory,
    source: StereoSource,
    reconstructor: FrameReconstructor,
    settings: PriorSettings,
) -> UsedPrior:
    """Return the axes of a prior: those set, else those that explain the first motions."""
    start = 0
    if source.stamps_s is not None:
        MotionPrior(prior, settings).check_covers(source.stamps_s)
        start = first_moving(prior, source.stamps_s, settings)
    frames = (OdometryFrame(*reconstructor.match(pair)) for pair in source.frames(start))
    found = find_axes(prior, frames, settings)
    if settings.axes != "auto":
        return UsedPrior(settings.axes, "settings", {} if found is None else found.sigmas)
    if found is None:
        return UsedPrior("camera", "assumed")
    return UsedPrior(found.axes, "images", found.sigmas)


def odometry_of(
    config: DriveSettings,
    source: StereoSource,
    known_poses: Trajectory | None,
    prior: Trajectory | None,
    used: UsedPrior | None,
    guide: Guide | None = None,
) -> Odometry:
    """Return the odometry of a drive, or known poses, one per frame, that take its place."""
    if known_poses is None:
        settings = config.odometry
        if used is not None:
            axes = settings.prior.model_copy(update={"axes": used.axes})
            settings = settings.model_copy(update={"prior": axes})
        return make_odometry(settings.method, settings, prior, config.scale, guide)
    return KnownPoses(_of_frames(known_poses, source))


def arriving_guide(
    source: StereoSource, reconstructor: FrameReconstructor, config: DriveSettings
) -> Guide | None:
    """Return what else says how a live drive moves: its wheels, or else its inertial unit."""
    if source.recent_path() is not None:
        camera = config.odometry.prior.model_copy(update={"axes": "camera"})
        return ArrivingPath(source.recent_path, camera)
    if not config.odometry.imu:
        return None
    R_left = turns_of(source.calibration, config.rectification).R_left
    return ArrivingGyro(source.read_imu, R_left, reconstructor.camera.focal_px, config.scale)


def imu_of(
    source: StereoSource, reconstructor: FrameReconstructor, config: DriveSettings
) -> FittedImu | None:
    """Return what the drive shows of its inertial unit; None = it has none, or it is not wanted."""
    stamps_s = source.stamps_s
    if source.live or not config.odometry.imu or stamps_s is None or len(stamps_s) < 2:
        return None
    try:
        record = source.read_imu()
    except ReconError as error:
        return FittedImu(None, (f"IMU not used: {error}",))
    if record is None:
        return None
    T_camera_imu = record.T_camera_imu
    if T_camera_imu is not None:
        R_left = turns_of(source.calibration, config.rectification).R_left
        T_camera_imu = make_transform(R_left, np.zeros(3)) @ T_camera_imu
    fitted = fit_imu(record, stamps_s, lambda: seen_runs(source, reconstructor), T_camera_imu)
    guide = fitted.guide
    return replace(fitted, guide=guide and replace(guide, scale=config.scale))


def mount_of(
    source: StereoSource, settings: RectificationSettings
) -> tuple[Mount | None, list[str]]:
    """Return where the rectified view of the left camera is on the robot, or why nobody knows."""
    try:
        mount = source.read_mount()
    except ReconError as error:
        return None, [f"transforms of the robot not used: {error}"]
    if mount is None:
        return None, []
    T_camera_view = make_transform(turns_of(source.calibration, settings).R_left.T, np.zeros(3))
    return replace(mount, T_base_camera=mount.T_base_camera @ T_camera_view), []


def doubt_poses(
    known_poses: Trajectory, source: StereoSource, config: DriveSettings
) -> tuple[str, ...]:
    """Return a line if known poses contradict the first motions that the cameras see."""
    poses = _of_frames(known_poses, source).T_world_camera
    by_number = Trajectory(poses, np.arange(len(poses), dtype=np.float64))
    if len(poses) < 2:
        return ()
    start = first_moving(by_number, by_number.timestamps_s, _KNOWN)
    pairs = (replace(pair, timestamp_s=float(pair.index)) for pair in source.frames(start))
    reconstructor = FrameReconstructor(source.calibration, config)
    frames = (OdometryFrame(*reconstructor.match(pair)) for pair in pairs)
    try:
        found = find_axes(by_number, frames, _KNOWN)
    except RegistrationError as error:
        what = f"contradict what the cameras see ({error.got})"
    else:
        if found is None or found.axes == "camera":
            return ()
        what = "fit what the cameras see as those of a body (x forward, z up), not of the camera"
    must = "they must be T_world_camera of this drive, in metres, z forward, one for each frame"
    return (f"the known poses {what}; {must}",)


def _of_frames(known_poses: Trajectory, source: StereoSource) -> Trajectory:
    lines = source.lines(len(known_poses))
    if lines is None:
        raise RegistrationError(
            "fewer known poses than frames",
            got=counted(len(known_poses), "pose"),
            expected=f"{len(source)}",
            hint="the pose file must list every frame of the source",
        )
    poses, times_s = known_poses.T_world_camera[lines], known_poses.timestamps_s[lines]
    return Trajectory(poses, times_s)
