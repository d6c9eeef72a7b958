"""Rotation errors where the alignment of a straight path leaves the roll about it open."""

from __future__ import annotations

from typing import Final

import numpy as np

from recon.core.geometry.se3 import exp_so3, quaternion_from_rotation
from recon.core.values import Trajectory
from recon.core.values.arrays import Float64

# A path is straight if its width (rms) is at most this share of its length (rms).
_STRAIGHT: Final = 0.05
# The positions fix the roll to about their error over the width of the path, in radians.
_FIXED_RAD: Final = float(np.radians(0.5))


def open_roll_axis(estimate: Trajectory, truth: Trajectory) -> Float64 | None:
    """Return the direction of a straight path about which aligned positions do not fix the roll.

    Args:
        estimate: The estimate, aligned to the true path by positions.
        truth: The true path.

    Returns:
        float64 (3,), world axes of ``truth``; None if the positions fix every rotation.
    """
    centred = truth.positions_m - truth.positions_m.mean(axis=0)
    _, _, directions = np.linalg.svd(centred, full_matrices=False)
    along = directions[0]
    length_m, width_m = _rms(centred @ along), _rms(_across(centred, along))
    away_m = _rms(_across(estimate.positions_m - truth.positions_m, along))
    fixed = away_m < _FIXED_RAD * width_m
    return None if fixed or width_m > _STRAIGHT * length_m else np.asarray(along)


def without_roll(estimate: Trajectory, truth: Trajectory, axis: Float64) -> Trajectory:
    """Return the estimate with its poses rolled alike about an axis until their rotations fit best.

    Positions stay as they are: across the axis they are too close to it to be moved.
    """
    wrong = truth.T_world_camera[:, :3, :3] @ np.swapaxes(estimate.T_world_camera[:, :3, :3], 1, 2)
    xyzw = np.array([quaternion_from_rotation(each) for each in wrong])
    rolls = 2 * np.arctan2(xyzw[:, :3] @ axis, xyzw[:, 3])
    mean = np.arctan2(np.sin(rolls).mean(), np.cos(rolls).mean())
    poses = estimate.T_world_camera.copy()
    poses[:, :3, :3] = exp_so3(mean * axis) @ poses[:, :3, :3]
    return Trajectory(poses, estimate.timestamps_s)


def _across(vectors: Float64, axis: Float64) -> Float64:
    return np.asarray(vectors - np.outer(vectors @ axis, axis))


def _rms(values: Float64) -> float:
    return float(np.sqrt((values**2).sum() / len(values)))
