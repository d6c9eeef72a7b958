"""The constant-velocity motion model."""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import Final

import numpy as np

from recon.core.geometry.se3 import exp_so3, invert, log_so3, make_transform, orthonormalise
from recon.core.values.arrays import Float64

_LONGEST_GAP: Final = 20.0
"""In intervals: over a longer gap the motion is not extrapolated in time, but repeated once."""


@dataclass(frozen=True, eq=False)
class Motion:
    """The last pose, and how the camera moved to it.

    Attributes:
        T_world_camera: float64 (4, 4), the last pose.
        T_before_camera: float64 (4, 4), the motion to it.
        timestamp_s: Time of the last pose.
        interval_s: Time that the motion took; 0 = not known.
    """

    T_world_camera: Float64
    timestamp_s: float
    T_before_camera: Float64 = field(default_factory=lambda: np.eye(4))
    interval_s: float = 0.0

    def predict(self, timestamp_s: float) -> Float64:
        """Return the pose (4, 4) at a time: with constant velocity, where times are known."""
        passed_s = timestamp_s - self.timestamp_s
        share = passed_s / self.interval_s if self.interval_s > 0.0 else 1.0
        if not 0.0 < share <= _LONGEST_GAP:
            share = 1.0
        return orthonormalise(self.T_world_camera @ part_of(self.T_before_camera, share))

    def moved(self, T_world_camera: Float64, timestamp_s: float) -> Motion:
        """Return the model after a measured pose, which gives a new motion."""
        motion = invert(self.T_world_camera) @ T_world_camera
        return Motion(T_world_camera, timestamp_s, motion, timestamp_s - self.timestamp_s)

    def drifted(self, timestamp_s: float) -> Motion:
        """Return the model after a frame without a measured pose: the same motion continues."""
        T = self.predict(timestamp_s)
        return Motion(T, timestamp_s, self.T_before_camera, self.interval_s)


def part_of(T: Float64, share: float) -> Float64:
    """Return a fraction or multiple of a motion (4, 4): rotation and translation in proportion."""
    if share == 1.0:
        return T
    return make_transform(exp_so3(share * log_so3(T[:3, :3])), share * T[:3, 3])
