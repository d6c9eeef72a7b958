"""Motion by other sensors, as visual odometry uses it: a first guess, and what bridges and holds.

Where a gyro knows how the camera turned, three unknowns are left of a motion, and two features fix
them: a few that agree are then no chance, however many others are wrong.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Final, Protocol

import numpy as np

from recon.core.geometry.se3 import Motion, as_step, invert, make_transform
from recon.core.values import RectifiedCamera
from recon.core.values.arrays import Bool, Float64
from recon.odometry.pose import REPROJECTION_PX, KnownPose, LocatedCamera

MAX_SIGMAS: Final = 4.7
"""Two measures of one motion that differ by more standard deviations of their difference contradict
each other: 0.1 % of right ones do, with six degrees of freedom."""

MIN_HELD: Final = 8
"""Fewer tracks that agree on a translation give no pose. Two fix it; that six more of a hundred
wrong ones, each with a chance of 1 %, agree with one of some hundred translations, happens once in
a hundred times, and then they contradict the turn."""
_MIN_HELD_RATIO: Final = 0.05  # of many tracks, more agree by chance
_PAIRS: Final = 300  # pairs of features whose translations are tried
_SIGMAS: Final = 3.0
_ROUNDS: Final = 3


@dataclass(frozen=True, eq=False)
class Guided:
    """Where other sensors say the camera is."""

    T_world_camera: Float64  # (4, 4)
    covariance: Float64  # (6, 6) of a step in the axes of the camera, metres and radians
    # As sure of the turn as features are: a part of the adjustment, and a few features are enough
    holds: bool = False
    scale: float = 1.0  # size of the scene against a road, which says what is sure enough

    @property
    def name(self) -> str:
        return "the IMU" if self.holds else "the prior"

    @property
    def sigma_m(self) -> float:
        """Standard deviation of the position, the mean over the axes."""
        return float(np.sqrt(np.trace(self.covariance[:3, :3]) / 3))

    @property
    def sigma_deg(self) -> float:
        return float(np.rad2deg(np.sqrt(np.trace(self.covariance[3:, 3:]) / 3)))

    @property
    def information(self) -> Float64:
        return np.asarray(np.linalg.inv(self.covariance))

    @property
    def known(self) -> KnownPose:
        """Its turn alone: that a camera goes on as it did is no measurement."""
        information = np.zeros((6, 6))
        information[3:, 3:] = np.linalg.inv(self.covariance[3:, 3:])
        return KnownPose(self.T_world_camera, information)

    def off(self, T_world_camera: Float64) -> Float64:
        """Return the step (6,) to here from another pose."""
        return as_step(invert(T_world_camera) @ self.T_world_camera)

    def enough_agree(self, agreeing: int, tracks: int) -> bool:
        """Whether so many of the tracks agree that a pose that has the turn counts as measured."""
        return agreeing >= max(MIN_HELD, _MIN_HELD_RATIO * tracks)

    def locate(
        self, xyz_world: Float64, uv: Float64, camera: RectifiedCamera
    ) -> LocatedCamera | None:
        """Locate the camera by points (N, 3) seen at (N, 2), its turn held.

        The translations of pairs of points are tried, always the same pairs; None = too few points
        agree with any.
        """
        if len(xyz_world) < MIN_HELD:
            return None
        turned = xyz_world @ self.T_world_camera[:3, :3]
        rays = (uv - [camera.cx_px, camera.cy_px]) / camera.focal_px
        limit_px = REPROJECTION_PX + _SIGMAS * np.deg2rad(self.sigma_deg) * camera.focal_px
        limit = limit_px / camera.focal_px
        pairs = np.random.default_rng(0).integers(0, len(uv), (_PAIRS, 2))
        # A point ``p + t`` is seen along (x, y, 1) where ``(p + t)_x = x (p + t)_z``, and so for y.
        # Errors of what is near are as large in the image as those of what is far.
        depth = np.maximum(turned[:, 2], 1e-3)
        J = np.zeros((len(turned), 2, 3))
        J[:, 0, 0] = J[:, 1, 1] = 1.0
        J[:, :, 2] = -rays
        J, off = J / depth[:, None, None], (rays * turned[:, 2:] - turned[:, :2]) / depth[:, None]
        A, b = np.einsum("nki,nkj->nij", J, J), np.einsum("nki,nk->ni", J, off)
        tried = _solved(A[pairs].sum(axis=1), b[pairs].sum(axis=1))
        agree = max((_near(turned, rays, t, limit) for t in tried), key=np.count_nonzero)
        for _ in range(_ROUNDS):
            moved = _solved(A[agree].sum(axis=0)[None], b[agree].sum(axis=0)[None])[0]
            agree = _near(turned, rays, moved, limit)
        if not self.enough_agree(int(agree.sum()), len(uv)):
            return None
        R = self.T_world_camera[:3, :3]
        return LocatedCamera(make_transform(R, -R @ moved), agree)


def _solved(A: Float64, b: Float64) -> Float64:
    return np.asarray(np.linalg.solve(A + 1e-9 * np.eye(3), b[..., None])[..., 0])


def _near(turned: Float64, rays: Float64, t: Float64, limit: float) -> Bool:
    """Return which points (N,) are seen within a limit, at distance 1, after a translation."""
    place = turned + t
    with np.errstate(divide="ignore", invalid="ignore"):
        off = np.linalg.norm(place[:, :2] / place[:, 2:] - rays, axis=1)
    return np.asarray((off <= limit) & (place[:, 2] > 0))


class Guide(Protocol):
    """Other sensors that say how the camera moves."""

    def guide(self, last: Motion, seen: Motion, to_s: float) -> Guided | None:
        """Return where the camera is at a time; None = they do not know.

        ``last`` is the last pose, ``seen`` that of the last frame that features gave one.
        """
        ...
