"""Which part of an ICP correction is applied: a Kalman update with outlier tests."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Final

import numpy as np

from recon.core.values.arrays import Float64
from recon.odometry.covariance import covariance_of, step_covariance
from recon.odometry.surfaces import Fit

MIN_OVERLAP: Final = 0.5
"""Least share of points that lie in a cell of the map."""

_MIN_RESIDUAL_GAIN: Final = 0.02
"""Least relative decrease of the median residual."""

_MAX_SIGMAS: Final = 4.7
"""Corrections farther from the prior, in standard deviations of their difference, are refused:
0.1 % of right ones, with six degrees of freedom."""

_MIN_SHARE: Final = 0.1
"""Directions in which the Kalman gain is smaller are not corrected: there ICP knows no more than
the prior."""

_ICP_INDEPENDENCE: Final = 0.05
"""Share of the points whose errors count as independent."""

_ICP_FLOOR_M: Final = 0.02
"""Standard deviation of ICP's translation that more points do not improve."""

_ICP_FLOOR_DEG: Final = 0.05
"""That of its rotation."""


@dataclass(frozen=True, eq=False)
class Correction:
    """How ICP would move the prior, and how the frame fits the map with and without it.

    Attributes:
        step: float64 (6,), translation in metres and rotation vector in radians, in camera axes
            of the prior.
        before: The frame against the map, at the prior.
        after: The same at ICP's pose.
    """

    step: Float64
    before: Fit
    after: Fit


@dataclass(frozen=True, eq=False)
class Verdict:
    """The part of a correction that is applied.

    Attributes:
        step: float64 (6,), the part; zero where the correction is refused.
        accepted: Whether any of it is applied.
        note: Why it is refused; empty where it is not.
    """

    step: Float64
    accepted: bool
    note: str = ""


def judge(correction: Correction, offset: Float64, prior_covariance: Float64) -> Verdict:
    """Weigh an ICP correction against its prior.

    A Kalman update: in each direction the correction is weighted by the certainty of ICP against
    that of the prior. Along a corridor ICP knows nothing, and nothing is applied.

    Args:
        correction: How ICP would move the prior.
        offset: float64 (6,), mean of ICP's corrections, a bias that is subtracted.
        prior_covariance: float64 (6, 6) of a step of the prior, metres and radians.
    """
    if correction.after.overlap < MIN_OVERLAP:
        return _refused(f"overlap {correction.after.overlap:.2f} under {MIN_OVERLAP:g}")
    fall = 1.0 - correction.after.residual_m / max(correction.before.residual_m, 1e-12)
    if not fall >= _MIN_RESIDUAL_GAIN:
        change = "falls" if fall > 0 else "rises"
        return _refused(f"residual {change} by {abs(100 * fall):.1f} %")
    news = correction.step - offset
    covariance = icp_covariance(correction.after)
    both = prior_covariance + covariance
    sigmas = float(np.sqrt(news @ np.linalg.solve(both, news)))
    if sigmas > _MAX_SIGMAS:
        return _refused(f"correction is {sigmas:.1f} sigma from the prior")
    step = _worthwhile(prior_covariance, both, news)
    if not step.any():
        return _refused("ICP knows no better than the prior")
    return Verdict(step, accepted=True)


def icp_may_help(prior: Float64, icp: Float64) -> bool:
    """Return whether ICP with some covariance would improve a prior in any direction."""
    share, _ = _shares(prior, prior + icp)
    return bool(share.max() >= _MIN_SHARE)


def best_covariance() -> Float64:
    """Return the covariance (6, 6) of ICP at its best: what the bias of the surfaces leaves."""
    return step_covariance(_ICP_FLOOR_M, _ICP_FLOOR_DEG)


def icp_covariance(fit: Fit) -> Float64:
    """Return the covariance (6, 6) of ICP: from the surfaces that fix it, at least their bias."""
    return covariance_of(_ICP_INDEPENDENCE * fit.information) + best_covariance()


def _worthwhile(prior: Float64, both: Float64, news: Float64) -> Float64:
    """Return the Kalman step, without the directions of small gain."""
    share, directions = _shares(prior, both)
    kept = np.where(share >= _MIN_SHARE, share, 0.0)
    return np.asarray(directions @ (kept * np.linalg.solve(directions, news)))


def _shares(prior: Float64, both: Float64) -> tuple[Float64, Float64]:
    """Return gains (6,) in independent directions, and these directions (6, 6), one per column.

    Whitened by ``both = L·Lᵀ``, the Kalman gain ``prior·both⁻¹`` is symmetric; its eigenvalues are
    the gains.
    """
    L = np.linalg.cholesky(both)
    half = np.linalg.solve(L, prior)
    share, axes = np.linalg.eigh(np.linalg.solve(L, half.T))
    return share, np.asarray(L @ axes)


def _refused(note: str) -> Verdict:
    return Verdict(np.zeros(6), accepted=False, note=note)
