"""Poses between others, and the nearest of sorted numbers, such as times."""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import NDArray

from recon.core.geometry.se3 import exp_so3, log_so3, make_transform
from recon.core.values import Trajectory
from recon.core.values.arrays import Float64, Int32


def interpolate_poses(trajectory: Trajectory, stamps_s: Float64) -> Float64:
    """Return poses at given times, interpolated between the poses before and after each.

    Args:
        trajectory: At least one pose.
        stamps_s: float64 (N,); outside the time range of the trajectory, its first or last pose
            is returned.

    Returns:
        float64 (N, 4, 4).
    """
    times = trajectory.timestamps_s
    after = np.clip(np.searchsorted(times, stamps_s), 1, max(1, len(times) - 1))
    after = np.minimum(after, len(times) - 1)
    before = np.maximum(after - 1, 0)
    span = np.where(times[after] > times[before], times[after] - times[before], 1.0)
    shares = np.clip((stamps_s - times[before]) / span, 0.0, 1.0)
    poses = trajectory.T_world_camera
    return np.stack(
        [
            pose_between(poses[i], poses[j], float(share))
            for i, j, share in zip(before, after, shares, strict=True)
        ]
    )


def pose_between(first: Float64, second: Float64, share: float) -> Float64:
    """Return the pose (4, 4) at a fraction (0 to 1) of the way from one pose to another."""
    turn = log_so3(first[:3, :3].T @ second[:3, :3])
    position = (1 - share) * first[:3, 3] + share * second[:3, 3]
    return make_transform(first[:3, :3] @ exp_so3(share * turn), position)


def nearest_sorted(numbers: NDArray[Any], others: NDArray[Any]) -> Int32:
    """Return int32 (N,): for each number, the index of the nearest of the others (M ≥ 1, sorted).

    Of two that are equally near, it is the first.
    """
    after = np.clip(np.searchsorted(others, numbers), 0, len(others) - 1)
    before = np.maximum(after - 1, 0)
    earlier = np.abs(numbers - others[before]) <= np.abs(others[after] - numbers)
    return np.where(earlier, before, after).astype(np.int32)
