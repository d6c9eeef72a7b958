"""How far odometry may be off between two moments of a drive."""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from recon.geometry.se3 import angle_rad, invert
from recon.loops.settings import DriftSettings
from recon.structures.arrays import Bool, Float64


@dataclass(frozen=True)
class Drift:
    """Standard deviations of a motion that odometry tells.

    Attributes:
        position_m: Of where it ends.
        angle_rad: Of its rotation.
    """

    position_m: float
    angle_rad: float


def doubtful_path(T_world_camera: Float64, measured: Bool, settings: DriftSettings) -> Float64:
    """Path up to each frame, in which a metre without measurement counts as many.

    Args:
        T_world_camera: float64 (N, 4, 4).
        measured: bool (N,), False where a pose rests on no measurement.
        settings: How much such a frame counts.

    Returns:
        float64 (N,), metres.
    """
    step_m = np.linalg.norm(np.diff(T_world_camera[:, :3, 3], axis=0), axis=1)
    lost = ~measured[1:]
    step_m = np.where(lost, settings.lost_factor * step_m + settings.lost_m, step_m)
    return np.concatenate([np.zeros(min(1, len(measured))), np.cumsum(step_m)])


def drift_over(path_m: float, settings: DriftSettings) -> Drift:
    """How far odometry may be off after a path.

    The scale error is taken as constant, the heading as a random walk, whose position error
    is that of a straight drive, the worst there is: ``turn·√(path³/3)``.
    """
    position_m, turn_rad = spread_over(np.array(path_m), settings)
    return Drift(float(position_m), float(turn_rad))


def spread_over(path_m: Float64, settings: DriftSettings) -> tuple[Float64, Float64]:
    """The standard deviations of `drift_over` for many paths: of positions and of rotations."""
    turn = math.radians(settings.turn_deg)
    position_m = np.hypot(settings.share * path_m, turn * np.sqrt(path_m**3 / 3.0))
    return position_m, turn * np.sqrt(path_m)


def is_possible(
    T_difference: NDArray[np.float64], drift: Drift, floor: Drift, settings: DriftSettings
) -> bool:
    """Whether a motion differs from odometry's by no more than drift explains.

    Args:
        T_difference: float64 (4, 4), odometry's motion undone after the other one.
        drift: Of odometry over that motion.
        floor: Standard deviation of the other motion.
        settings: How many standard deviations are possible.
    """
    off_m = float(np.linalg.norm(T_difference[:3, 3]))
    off_rad = float(angle_rad(T_difference))
    sigma_m = math.hypot(drift.position_m, floor.position_m)
    sigma_rad = math.hypot(drift.angle_rad, floor.angle_rad)
    return off_m <= settings.sigmas * sigma_m and off_rad <= settings.sigmas * sigma_rad


def motion(T_world_camera: Float64, first: int, last: int) -> Float64:
    """``T_first_last`` (4, 4) of two poses of a stack."""
    T: Float64 = invert(T_world_camera[first]) @ T_world_camera[last]
    return T
