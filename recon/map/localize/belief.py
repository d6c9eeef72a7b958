"""A pose with its covariance: moved by odometry, corrected by what the map shows."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Final

import numpy as np

from recon.core.geometry.se3 import adjoint, as_step, as_transform, invert, orthonormalise
from recon.core.values.arrays import Float64
from recon.places.places import drift_over

MAX_SIGMA_M: Final = 0.15  # on a road
"""Poses less certain than this are not given out: an error of 0.5 m is then beyond three sigmas."""
MAX_SIGMA_DEG: Final = 1.0  # the same of the rotation
_MAX_CHI2: Final = 22.5
"""Chi-square, with six degrees of freedom, above which a correction contradicts: 0.1 % of right
ones are beyond."""


@dataclass(frozen=True, eq=False)
class Belief:
    """Where the camera is, ``T_world_camera`` in the world of the map.

    ``corrected``, float64 (6, 6), is the covariance of a step (translation in metres, rotation
    vector in radians) in camera axes, without the drift over the path since the last correction.
    """

    T_world_camera: Float64
    corrected: Float64
    path_m: float = 0.0
    scale: float = 1.0  # of the map, against a road

    @property
    def covariance(self) -> Float64:
        """float64 (6, 6) of a step in camera axes.

        Errors of the scale add up along the path, so its drift is not that of independent steps.
        """
        return self.corrected + drift_over(self.path_m, self.scale).covariance

    @property
    def sigma_m(self) -> float:
        """Standard deviation of the position in its worst direction."""
        return float(np.sqrt(np.linalg.eigvalsh(self.covariance[:3, :3])[-1]))

    @property
    def sigma_deg(self) -> float:
        """Standard deviation of the rotation about its worst axis."""
        return float(np.rad2deg(np.sqrt(np.linalg.eigvalsh(self.covariance[3:, 3:])[-1])))

    @property
    def certain(self) -> bool:
        return self.sigma_m <= self.scale * MAX_SIGMA_M and self.sigma_deg <= MAX_SIGMA_DEG

    def moved(self, T_before_now: Float64, covariance: Float64, path_m: float) -> Belief:
        """Return the belief after a motion by odometry; the covariance is in the new camera axes.

        ``path_m`` is its length, as drift counts it.
        """
        turn = adjoint(invert(T_before_now))
        spread = turn @ self.corrected @ turn.T + covariance
        T = orthonormalise(self.T_world_camera @ T_before_now)
        return Belief(T, spread, self.path_m + path_m, self.scale)

    def corrected_to(self, T_world_camera: Float64, covariance: Float64) -> Belief | None:
        """Return the belief after a measurement of the pose; None where the two contradict."""
        news = as_step(invert(self.T_world_camera) @ T_world_camera)
        ours = self.covariance
        both = ours + covariance
        if float(news @ np.linalg.solve(both, news)) > _MAX_CHI2:
            return None
        gain = np.linalg.solve(both, ours).T
        T = orthonormalise(self.T_world_camera @ as_transform(gain @ news))
        left = ours - gain @ ours
        return Belief(T, 0.5 * (left + left.T), scale=self.scale)
