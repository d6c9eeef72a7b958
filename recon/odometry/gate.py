"""Which part of an ICP correction is applied: a Kalman update with outlier tests."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from recon.core.values.arrays import Float64
from recon.odometry.covariance import covariance_of, step_covariance
from recon.odometry.settings import GateSettings
from recon.odometry.surfaces import Fit


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


def judge(
    correction: Correction, offset: Float64, prior_covariance: Float64, settings: GateSettings
) -> Verdict:
    """Weigh an ICP correction against its prior.

    A Kalman update: in each direction the correction is weighted by the certainty of ICP against
    that of the prior. Along a corridor ICP knows nothing, and nothing is applied.

    Args:
        correction: How ICP would move the prior.
        offset: float64 (6,), mean of ICP's corrections, a bias that is subtracted.
        prior_covariance: float64 (6, 6) of a step of the prior, metres and radians.
        settings: Limits, and how far ICP's own certainty is believed.
    """
    if correction.after.overlap < settings.min_overlap:
        return _refused(f"overlap {correction.after.overlap:.2f} under {settings.min_overlap:g}")
    fall = 1.0 - correction.after.residual_m / max(correction.before.residual_m, 1e-12)
    if not fall >= settings.min_residual_gain:
        change = "falls" if fall > 0 else "rises"
        return _refused(f"residual {change} by {abs(100 * fall):.1f} %")
    news = correction.step - offset
    covariance = icp_covariance(correction.after, settings)
    both = prior_covariance + covariance
    sigmas = float(np.sqrt(news @ np.linalg.solve(both, news)))
    if sigmas > settings.max_sigmas:
        return _refused(f"correction is {sigmas:.1f} sigma from the prior")
    step = _worthwhile(prior_covariance, both, news, settings.min_share)
    if not step.any():
        return _refused("ICP knows no better than the prior")
    return Verdict(step, accepted=True)


def icp_may_help(prior: Float64, icp: Float64, settings: GateSettings) -> bool:
    """Whether ICP with some covariance would improve a prior in any direction."""
    share, _ = _shares(prior, prior + icp)
    return bool(share.max() >= settings.min_share)


def icp_covariance(fit: Fit, settings: GateSettings) -> Float64:
    """Covariance (6, 6) of ICP: from the surfaces that fix it, with a floor for their bias."""
    floor = step_covariance(settings.icp_floor_m, settings.icp_floor_deg)
    return covariance_of(settings.icp_independence * fit.information) + floor


def _worthwhile(prior: Float64, both: Float64, news: Float64, min_share: float) -> Float64:
    """The Kalman step, without the directions of small gain."""
    share, directions = _shares(prior, both)
    kept = np.where(share >= min_share, share, 0.0)
    return np.asarray(directions @ (kept * np.linalg.solve(directions, news)))


def _shares(prior: Float64, both: Float64) -> tuple[Float64, Float64]:
    """Gains (6,) in independent directions, and these directions (6, 6), one per column.

    Whitened by ``both = L·Lᵀ``, the Kalman gain ``prior·both⁻¹`` is symmetric; its eigenvalues are
    the gains.
    """
    L = np.linalg.cholesky(both)
    half = np.linalg.solve(L, prior)
    share, axes = np.linalg.eigh(np.linalg.solve(L, half.T))
    return share, np.asarray(L @ axes)


def _refused(note: str) -> Verdict:
    return Verdict(np.zeros(6), accepted=False, note=note)
