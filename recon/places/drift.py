"""How far odometry may drift; larger figures give more candidates and refuse less."""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Final

import numpy as np
from numpy.typing import NDArray

from recon.core.geometry.se3 import angle_rad
from recon.core.values.arrays import Bool, Float64

_LOST_FACTOR: Final = 20.0
"""Metres that one metre of extrapolated path counts as."""

_LOST_M: Final = 2.0
"""Path that is added for each frame without a measurement."""

SIGMAS: Final = 3.5
"""Largest possible deviation from odometry, in standard deviations."""

SHARE: Final = 0.02
"""Standard deviation of a position, as a share of the path."""

TURN_DEG: Final = 0.15
"""Standard deviation of the heading after 1 m; it grows with the root of the path."""


@dataclass(frozen=True)
class Drift:
    """Standard deviations of a motion by odometry.

    Attributes:
        position_m: Of its translation.
        angle_rad: Of its rotation.
    """

    position_m: float
    angle_rad: float

    @property
    def covariance(self) -> Float64:
        """float64 (6, 6) of a step: translation in metres, rotation vector in radians."""
        return np.diag([self.position_m**2] * 3 + [self.angle_rad**2] * 3)


def path_lengths(T_world_camera: Float64, trusted: Bool) -> Float64:
    """Return length of the path up to each frame, in which extrapolated metres count several times.

    Args:
        T_world_camera: float64 (N, 4, 4).
        trusted: bool (N,), False where a pose is not, as it is extrapolated.

    Returns:
        float64 (N,), metres.
    """
    step_m = np.linalg.norm(np.diff(T_world_camera[:, :3, 3], axis=0), axis=1)
    lost = ~trusted[1:]
    step_m = np.where(lost, _LOST_FACTOR * step_m + _LOST_M, step_m)
    return np.concatenate([np.zeros(min(1, len(trusted))), np.cumsum(step_m)])


def drift_over(path_m: float) -> Drift:
    """Return the drift over a path.

    The scale error is constant and the heading a random walk. The position error of the latter is
    that of a straight drive, the worst case: ``turn·√(path³/3)``.
    """
    position_m, turn_rad = spread_over(np.array(path_m))
    return Drift(float(position_m), float(turn_rad))


def spread_over(path_m: Float64) -> tuple[Float64, Float64]:
    """Return `drift_over` of many paths (N,): standard deviations of positions and of rotations."""
    turn = math.radians(TURN_DEG)
    position_m = np.hypot(SHARE * path_m, turn * np.sqrt(path_m**3 / 3.0))
    return position_m, turn * np.sqrt(path_m)


def is_possible(T_difference: NDArray[np.float64], drift: Drift, other: Drift) -> bool:
    """Return whether a motion differs from odometry's by no more than drift explains.

    Args:
        T_difference: float64 (4, 4), inverse of odometry's motion times the other one.
        drift: Of odometry over that motion.
        other: Standard deviations of the other motion.
    """
    off_m = float(np.linalg.norm(T_difference[:3, 3]))
    off_rad = float(angle_rad(T_difference))
    sigma_m = math.hypot(drift.position_m, other.position_m)
    sigma_rad = math.hypot(drift.angle_rad, other.angle_rad)
    return off_m <= SIGMAS * sigma_m and off_rad <= SIGMAS * sigma_rad
