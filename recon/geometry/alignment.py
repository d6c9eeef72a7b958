"""The motion that brings one set of points, or one path, closest to another."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Final

import numpy as np

from recon.geometry.se3 import make_transform
from recon.structures import Trajectory
from recon.structures.arrays import Float64, freeze

_AXIS_M: Final = 20.0  # how far from its cameras most of a map lies
_IN_ONE_PLACE: Final = 1e-12


@dataclass(frozen=True, eq=False)
class Similarity:
    """A change of size, then a rigid motion: ``to = T_to_from · (scale · from)``.

    Attributes:
        T_to_from: float64 (4, 4).
        scale: Factor on the lengths; 1 = rigid.
    """

    T_to_from: Float64
    scale: float = 1.0

    def __post_init__(self) -> None:
        freeze(self, "T_to_from", np.float64, (4, 4))

    def move(self, trajectory: Trajectory) -> Trajectory:
        """A path in the other frame; its times stay."""
        poses = trajectory.T_world_camera.copy()
        poses[:, :3, 3] *= self.scale
        return Trajectory(self.T_to_from @ poses, trajectory.timestamps_s)


def fit_points(from_m: Float64, to_m: Float64, *, scaled: bool = False) -> Similarity:
    """The similarity with the least squares between corresponding points.

    A direction that the points leave open, such as the turn about a straight line, is not
    turned more than the others ask for.

    Args:
        from_m: float64 (N, 3), N ≥ 1.
        to_m: float64 (N, 3), where each should come to lie.
        scaled: Whether the size may change; it does not where all points lie in one place.

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


def fit_paths(from_path: Trajectory, to_path: Trajectory) -> Similarity:
    """The rigid motion that brings a path of cameras closest to another, pose by pose.

    Each pose counts as its centre and the ends of its axes, as long as cameras map: on a street
    that is nearly straight, centres alone leave the turn about it to their noise, and a map that
    hangs on them turns with it.

    Args:
        from_path: N ≥ 1 poses.
        to_path: As many, of the same camera.
    """
    return fit_points(_axes_m(from_path), _axes_m(to_path))


def _axes_m(path: Trajectory) -> Float64:
    """float64 (N · 4, 3): centre and ends of the axes of each camera."""
    poses = path.T_world_camera
    tips = np.swapaxes(poses[:, :3, :3], 1, 2) * _AXIS_M + poses[:, None, :3, 3]
    return np.concatenate([poses[:, None, :3, 3], tips], axis=1).reshape(-1, 3)
