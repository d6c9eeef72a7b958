"""Guides whose measurements arrive while the drive goes on, from its last seconds alone."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import Final

import numpy as np

from recon.core.geometry.se3 import Motion, distance_in_sigmas, log_so3
from recon.core.progress import LOGGER
from recon.core.values import ImuRecord, Trajectory
from recon.core.values.arrays import Float64
from recon.odometry.guide import MAX_SIGMAS, MIN_HELD, Guided
from recon.odometry.imu import Gyro, ImuGuide
from recon.odometry.imu_fit import LEAST_TURNS, NOISE, STATED
from recon.odometry.pose import REPROJECTION_PX
from recon.odometry.prior import MotionPrior
from recon.odometry.settings import PriorSettings

_MEMORY: Final = 20.0  # motions over which it is averaged how steadily the camera moves


@dataclass(frozen=True)
class ArrivingPath:
    """Wheels as a guide: ``recent`` gives the path of the camera by them, as far as it is known."""

    recent: Callable[[], Trajectory | None]
    settings: PriorSettings

    def guide(self, last: Motion, seen: Motion, to_s: float) -> Guided | None:
        """Return where the wheels put the camera; None = they have not said so yet."""
        path = self.recent()
        if path is None or len(path) < 2:
            return None
        return MotionPrior(path, self.settings).guide(last, seen, to_s)


class ArrivingGyro:
    """An inertial unit as a guide, whose errors are learnt from each motion that is seen.

    A Kalman filter over turn to the camera, bias and delay (`Gyro`), which begin as stated; the
    turn that features saw since the frame before corrects them. A unit that contradicts most of
    the first turns is not used, and that is said.

    Args:
        recent: Gives what the unit measured in the last seconds; None = nothing yet. Where it does
            not state how the unit lies to the camera, it is not used.
        R_left: (3, 3), from the left camera as it is recorded to its rectified view.
        focal_px: Of the rectified camera: how well turns are seen.
        scale: Size of the scene against a road.
    """

    def __init__(
        self,
        recent: Callable[[], ImuRecord | None],
        R_left: Float64,
        focal_px: float,
        scale: float = 1.0,
    ) -> None:
        self._recent, self._scale = recent, scale
        self._R_left = R_left
        self._R_camera_imu: Float64 | None = None
        self._said = False
        self.bias = np.zeros(3)  # radians per second, as far as it is known
        self._time_offset_s = 0.0
        self._covariance = np.diag(STATED**2)
        self._pixel_rad = 1.0 / focal_px
        self._seen: Motion | None = None
        self._turns = self._contradicted = 0
        self._unsteady2 = float("inf")
        self.used = True

    def guide(self, last: Motion, seen: Motion, to_s: float) -> Guided | None:
        """Return the turn since the last frame that was seen; None = features know it better."""
        record = self._recent() if self.used else None
        R_camera_imu = None if record is None else self._placed(record)
        if record is None or R_camera_imu is None:
            return None
        gyro = Gyro(record, R_camera_imu, self.bias, self._time_offset_s)
        if self._seen is None or seen.timestamp_s > self._seen.timestamp_s:
            gyro = self._learnt(gyro, self._seen, seen)
            self._seen = seen
        if not (self.used and np.isfinite(self._unsteady2)):
            return None
        unsteady = float(np.sqrt(self._unsteady2))
        how = ImuGuide(gyro, self._covariance, NOISE, unsteady, 0.0, scale=self._scale)
        guided = how.guide(last, seen, to_s)
        most_rad = REPROJECTION_PX * self._pixel_rad
        sure = guided is not None and np.deg2rad(guided.sigma_deg) <= most_rad
        return guided if sure else None

    def _placed(self, record: ImuRecord) -> Float64 | None:
        """Return how the unit lies to the camera (3, 3), as it is stated or was found since."""
        if self._R_camera_imu is None and record.T_camera_imu is not None:
            self._R_camera_imu = self._R_left @ record.T_camera_imu[:3, :3]
        if self._R_camera_imu is None and not self._said:
            self._said = True
            LOGGER.warning("IMU not used: no static transform says how it lies to the camera")
        return self._R_camera_imu

    def _learnt(self, gyro: Gyro, before: Motion | None, seen: Motion) -> Gyro:
        """Return the gyro, corrected by how the camera turned between two frames."""
        if before is None or not gyro.knows(before.timestamp_s, seen.timestamp_s):
            return gyro
        lasting_s = seen.timestamp_s - before.timestamp_s
        R, J = gyro.turned(before.timestamp_s, seen.timestamp_s)
        off = log_so3(R.T @ before.T_world_camera[:3, :3].T @ seen.T_world_camera[:3, :3])
        P = self._covariance
        sigma2 = self._pixel_rad**2 / MIN_HELD + NOISE**2 * lasting_s
        spread = J @ P @ J.T + sigma2 * np.eye(3)
        self._turns += 1
        if distance_in_sigmas(off, spread) > MAX_SIGMAS:
            self._contradicted += 1
            if self._turns >= LEAST_TURNS and 2 * self._contradicted > self._turns:
                self.used = False
                what = f"{self._contradicted} of the first {self._turns} turns are others"
                LOGGER.warning("IMU not used: it does not turn as the cameras do (%s)", what)
            return gyro
        gain = np.linalg.solve(spread, J @ P).T
        kept = np.eye(7) - gain @ J
        self._covariance = kept @ P @ kept.T + sigma2 * gain @ gain.T
        gyro = gyro.stepped(gain @ off)
        self._R_camera_imu, self.bias = gyro.R_camera_imu, gyro.bias
        self._time_offset_s = gyro.time_offset_s
        self._watch(before, seen, lasting_s)
        return gyro

    def _watch(self, before: Motion, seen: Motion, lasting_s: float) -> None:
        """Average the acceleration that moved the camera from where its last velocity led."""
        if not before.interval_s > 0:
            return
        moved = before.T_world_camera[:3, :3].T @ (
            seen.T_world_camera[:3, 3] - before.T_world_camera[:3, 3]
        )
        changing_s2 = 0.5 * lasting_s * (lasting_s + before.interval_s)  # as in `ImuGuide`
        off2 = float(np.mean(((moved - lasting_s * before.velocity) / changing_s2) ** 2))
        before2 = self._unsteady2 if np.isfinite(self._unsteady2) else off2
        self._unsteady2 = before2 + (off2 - before2) / _MEMORY
