"""Which part of an ICP correction is taken: as much as it knows better than the prior."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from recon.odometry.covariance import covariance_of, step_covariance
from recon.odometry.settings import GateSettings
from recon.odometry.surfaces import Fit
from recon.structures.arrays import Float64


@dataclass(frozen=True, eq=False)
class Correction:
    """What ICP would do to the prior, and how the frame fits the map with and without it.

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
    """What is taken of a correction.

    Attributes:
        step: float64 (6,), the part that is taken; zero where it was refused.
        accepted: True where any was taken.
        note: Why it was refused; empty where it was not.
    """

    step: Float64
    accepted: bool
    note: str = ""


def judge(
    correction: Correction, offset: Float64, prior_covariance: Float64, settings: GateSettings
) -> Verdict:
    """Weigh an ICP correction against its prior.

    A Kalman update: along each direction the correction counts by how sure ICP is there against
    how sure the prior is. Along a corridor ICP knows nothing and takes nothing.

    Args:
        correction: What ICP would do.
        offset: float64 (6,), the standing part of ICP's corrections, which is no news.
        prior_covariance: float64 (6, 6) of a step of the prior, metres and radians.
        settings: Limits, and how far each side's own confidence is believed.
    """
    if correction.after.overlap < settings.min_overlap:
        return _refused(f"overlap {correction.after.overlap:.2f} under {settings.min_overlap:g}")
    fall = 1.0 - correction.after.residual_m / max(correction.before.residual_m, 1e-12)
    if not fall >= settings.min_residual_gain:
        return _refused(f"residual changes by {-100 * fall:+.1f} %: too little")
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
    """Whether an ICP of some covariance would know better than a prior in any direction."""
    share, _ = _shares(prior, prior + icp)
    return bool(share.max() >= settings.min_share)


def icp_covariance(fit: Fit, settings: GateSettings) -> Float64:
    """Covariance (6, 6) of ICP: from the surfaces it rests on, with a floor for their bias."""
    floor = step_covariance(settings.icp_floor_m, settings.icp_floor_deg)
    return covariance_of(settings.icp_independence * fit.information) + floor


def _worthwhile(prior: Float64, both: Float64, news: Float64, min_share: float) -> Float64:
    """The Kalman step, without the directions in which little of the news would be taken."""
    share, directions = _shares(prior, both)
    kept = np.where(share >= min_share, share, 0.0)
    return np.asarray(directions @ (kept * np.linalg.solve(directions, news)))


def _shares(prior: Float64, both: Float64) -> tuple[Float64, Float64]:
    """Shares (6,) taken in independent directions, and these (6, 6), one a column.

    With ``both = L·Lᵀ`` the Kalman gain ``prior·both⁻¹`` becomes symmetric; its eigenvalues are
    the shares.
    """
    L = np.linalg.cholesky(both)
    half = np.linalg.solve(L, prior)
    share, axes = np.linalg.eigh(np.linalg.solve(L, half.T))
    return share, np.asarray(L @ axes)


def _refused(note: str) -> Verdict:
    return Verdict(np.zeros(6), accepted=False, note=note)
