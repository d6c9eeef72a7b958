"""Covariances of steps: a translation in metres and a rotation vector in radians."""

from __future__ import annotations

from typing import Final

import numpy as np

from recon.core.values.arrays import Float64

_LEAST_INFORMATION: Final = 1e-4
"""Added along every direction, so that one that nothing fixes gets 100 m or rad, not infinity."""


def covariance_of(information: Float64) -> Float64:
    """Return the covariance (6, 6) of an information matrix (6, 6), which may be singular."""
    return np.asarray(np.linalg.inv(information + _LEAST_INFORMATION * np.eye(6)))


def step_covariance(sigma_m: float, sigma_deg: float) -> Float64:
    """Return the covariance (6, 6) of a step that is equally uncertain in all directions."""
    return np.diag(np.repeat([sigma_m**2, np.deg2rad(sigma_deg) ** 2], 3))


def distance_in_sigmas(step: Float64, covariance: Float64) -> float:
    """Return the length of a step (6,) in standard deviations (Mahalanobis distance)."""
    return float(np.sqrt(step @ np.linalg.solve(covariance, step)))
