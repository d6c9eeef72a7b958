"""The motion of the camera by other sensors: wheels, an inertial unit, a satellite receiver."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Final

import numpy as np

from recon.core.errors import RegistrationError
from recon.core.geometry.se3 import (
    Motion,
    invert,
    make_transform,
    orthonormalise,
    part_of,
    step_covariance,
)
from recon.core.values import Trajectory
from recon.core.values.arrays import Float64
from recon.odometry.guide import Guided
from recon.odometry.settings import PriorSettings

_CAMERA_FROM_BODY: Final = np.array([[0.0, -1.0, 0.0], [0.0, 0.0, -1.0], [1.0, 0.0, 0.0]])
"""Camera axes (x right, y down, z forward) of body axes (x forward, y left, z up)."""

_MAX_GAP_S: Final = 1.0
"""Poses farther apart in time are not interpolated: a vehicle brakes or turns within it."""
MAX_SIGMAS: Final = 4.7
"""Two measures of one motion that differ by more standard deviations of their difference contradict
each other: 0.1 % of right ones do, with six degrees of freedom."""


@dataclass(frozen=True, eq=False)
class MotionPrior:
    """A path of the same rig on the same clock, of which only relative motions are used."""

    path: Trajectory  # poses at any rate and in any world frame
    settings: PriorSettings  # axes, gaps, accuracy

    def __post_init__(self) -> None:
        if len(self.path) < 2:
            raise RegistrationError(
                "a prior of the motion needs two poses", got=f"{len(self.path)}", hint="see --prior"
            )

    def check_covers(self, stamps_s: Float64) -> None:
        """Refuse a path that gives no motion between the frames of a drive, taken at times (N,)."""
        known = np.array([self.knows(float(t)) for t in stamps_s])
        if len(stamps_s) < 2 or (known[1:] & known[:-1]).any():
            return
        spans = [f"{t[0]:.3f} to {t[-1]:.3f} s" for t in (self.path.timestamps_s, stamps_s)]
        raise RegistrationError(
            "the prior does not cover the drive",
            got=f"poses from {spans[0]}",
            expected=f"frames from {spans[1]}, poses at most {_MAX_GAP_S:g} s apart",
            hint="both must use the same clock, in seconds",
        )

    def knows(self, time_s: float) -> bool:
        return self._pose_at(time_s) is not None

    def motion(self, from_s: float, to_s: float) -> Float64 | None:
        """T_from_to (4, 4) of the camera between two times; None = a gap in the path."""
        start, end = self._pose_at(from_s), self._pose_at(to_s)
        if start is None or end is None or not to_s > from_s:
            return None
        T = invert(start) @ end
        if self.settings.axes == "body":
            turn = make_transform(_CAMERA_FROM_BODY, np.zeros(3))
            T = turn @ T @ invert(turn)
        return orthonormalise(T)

    def guide(self, last: Motion, seen: Motion, to_s: float) -> Guided | None:
        """Return where the path puts the camera, as sure as of a motion from frame to frame."""
        T = self.motion(last.timestamp_s, to_s)
        if T is None:
            return None
        return Guided(last.T_world_camera @ T, step_covariance(*self.sigmas(T)))

    def sigmas(self, T_from_to: Float64) -> tuple[float, float]:
        """Standard deviations of a motion: translation in metres, rotation in degrees."""
        s, length_m = self.settings, float(np.linalg.norm(T_from_to[:3, 3]))
        return s.sigma_m + s.sigma_ratio * length_m, s.sigma_deg

    def _pose_at(self, time_s: float) -> Float64 | None:
        """The pose (4, 4) at a time, interpolated; None = outside the path or in a gap."""
        times_s = self.path.timestamps_s
        if not times_s[0] <= time_s <= times_s[-1]:
            return None
        after = int(np.searchsorted(times_s, time_s, side="left"))
        T_after: Float64 = self.path.T_world_camera[after]
        if times_s[after] == time_s:
            return T_after
        gap_s = times_s[after] - times_s[after - 1]
        if gap_s > _MAX_GAP_S:
            return None
        T_before = self.path.T_world_camera[after - 1]
        ratio = float((time_s - times_s[after - 1]) / gap_s)
        return np.asarray(T_before @ part_of(invert(T_before) @ T_after, ratio))
