"""Least-squares alignment of corresponding points and of trajectories."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Final

import numpy as np

from recon.core.geometry.se3 import make_transform
from recon.core.values import Trajectory
from recon.core.values.arrays import Float64, freeze

_AXIS_M: Final = 20.0  # typical distance of a map from its cameras
_UP_M: Final = np.array([0.0, 0.0, 3.0])
"""Short beside a path, whose tilt is to count, and longer than a straight one is wide."""
_IN_ONE_PLACE: Final = 1e-12


@dataclass(frozen=True, eq=False)
class Similarity:
    """A scaling followed by a rigid transform: ``to = T_to_from · (scale · from)``.

    Attributes:
        T_to_from: float64 (4, 4).
        scale: Scale factor; 1 = rigid.
    """

    T_to_from: Float64
    scale: float = 1.0

    def __post_init__(self) -> None:
        freeze(self, "T_to_from", np.float64, (4, 4))

    def move(self, trajectory: Trajectory) -> Trajectory:
        """Return the trajectory in the other frame; its timestamps do not change."""
        poses = trajectory.T_world_camera.copy()
        poses[:, :3, 3] *= self.scale
        return Trajectory(self.T_to_from @ poses, trajectory.timestamps_s)


def fit_points(from_m: Float64, to_m: Float64, *, scaled: bool = False) -> Similarity:
    """Return the least-squares similarity between corresponding points.

    A rotation that the points do not determine, such as that about a straight line, is left as
    small as the others allow.

    Args:
        from_m: float64 (N, 3), N ≥ 1.
        to_m: float64 (N, 3), the corresponding points.
        scaled: Whether to estimate the scale; it stays 1 if all points coincide.

    Ref: S. Umeyama, "Least-squares estimation of transformation parameters between two point
    patterns", PAMI 13(4), 1991, equations 40 to 42.
    """
    from_mean, to_mean = from_m.mean(axis=0), to_m.mean(axis=0)
    centred = from_m - from_mean
    U, strength, Vt = np.linalg.svd((to_m - to_mean).T @ centred / len(from_m))
    signs = np.array([1.0, 1.0, np.sign(np.linalg.det(U @ Vt))])
    rotation = (U * signs) @ Vt
    variance = float(np.mean(np.sum(centred**2, axis=1)))
    possible = scaled and variance > _IN_ONE_PLACE
    scale = float(strength @ signs) / variance if possible else 1.0
    return Similarity(make_transform(rotation, to_mean - scale * rotation @ from_mean), scale)


def fit_upright(from_m: Float64, to_m: Float64) -> Similarity:
    """Return the least-squares rigid transform between points in two frames whose z is up.

    Each point counts with the one three metres above it. The points of a straight street alone,
    such as positions by GNSS, would leave the roll about it to noise, and a map on its side.

    Args:
        from_m: float64 (N, 3), N ≥ 1.
        to_m: float64 (N, 3), the corresponding points.
    """
    return fit_points(np.vstack([from_m, from_m + _UP_M]), np.vstack([to_m, to_m + _UP_M]))


def fit_paths(from_path: Trajectory, to_path: Trajectory) -> Similarity:
    """Return the rigid transform that brings a trajectory closest to another, pose by pose.

    Each pose contributes its camera centre and the ends of its axes, whose length is the typical
    distance of mapped points. On a nearly straight street, the centres alone would leave the
    rotation about it to noise, and the map would rotate with it.
    """
    return fit_points(_axes_m(from_path), _axes_m(to_path))


def _axes_m(path: Trajectory) -> Float64:
    """Return float64 (N · 4, 3): centre and axis ends of each camera."""
    poses = path.T_world_camera
    tips = np.swapaxes(poses[:, :3, :3], 1, 2) * _AXIS_M + poses[:, None, :3, 3]
    return np.concatenate([poses[:, None, :3, 3], tips], axis=1).reshape(-1, 3)
