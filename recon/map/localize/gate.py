"""Whether a correction by ICP is worth applying: it fits better, is likely, and knows more.

And whether the surfaces could have refused it: in a street they fit as well half a metre on.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Final

import numpy as np

from recon.core.values.arrays import Float64
from recon.map.localize.surfaces import Fit
from recon.odometry.prior import MAX_SIGMAS
from recon.odometry.window import covariance_of, distance_in_sigmas, step_covariance

_MIN_OVERLAP: Final = 0.5
"""Least share of points that lie in a cell of the map."""

_MIN_RESIDUAL_GAIN: Final = 0.02
"""Least relative decrease of the median residual."""

_MIN_SHARE: Final = 0.1
"""Least Kalman gain, in the direction in which it is largest: with less, ICP knows no more than the
prior."""

_ICP_INDEPENDENCE: Final = 0.05
"""Share of the points whose errors count as independent."""

_MIN_CONTRAST: Final = 2.0 * math.log(1000.0)
"""Chi-square by which any pose that is wrong must fit worse: it is a thousand times less likely."""

_ICP_FLOOR_M: Final = 0.02
"""Standard deviation of ICP's translation that more points do not improve."""

_ICP_FLOOR_DEG: Final = 0.05
"""That of its rotation."""


@dataclass(frozen=True, eq=False)
class Correction:
    """How ICP would move the prior, and how the frame fits the map with and without it.

    Attributes:
        step: float64 (6,), translation in metres and rotation vector in radians, in camera axes
            of the prior; without the bias that all corrections share.
        before: The frame against the map, at the prior.
        after: The same at ICP's pose.
        contrast: By how much the poses around ICP's fit worse, see `contrast`.
    """

    step: Float64
    before: Fit
    after: Fit
    contrast: float


def is_worthwhile(correction: Correction, prior_covariance: Float64) -> bool:
    """Return whether ICP improves on its prior.

    Args:
        correction: How ICP would move the prior.
        prior_covariance: float64 (6, 6) of a step of the prior, metres and radians.
    """
    before, after, step = correction.before, correction.after, correction.step
    # A residual that is not known compares as False.
    if not after.residual_m <= (1.0 - _MIN_RESIDUAL_GAIN) * before.residual_m:
        return False
    if _ICP_INDEPENDENCE * correction.contrast < _MIN_CONTRAST:
        return False
    both = prior_covariance + icp_covariance(after)
    likely = distance_in_sigmas(step, both) <= MAX_SIGMAS
    return after.overlap >= _MIN_OVERLAP and likely and _gain(prior_covariance, both) >= _MIN_SHARE


def icp_covariance(fit: Fit) -> Float64:
    """Return the covariance (6, 6) of ICP: from the surfaces that fix it, at least their bias."""
    floor = step_covariance(_ICP_FLOOR_M, _ICP_FLOOR_DEG)
    return covariance_of(_ICP_INDEPENDENCE * fit.information) + floor


def _gain(prior: Float64, both: Float64) -> float:
    """Return the Kalman gain in the direction in which it is largest.

    Whitened by ``both = L·Lᵀ``, the gain ``prior·both⁻¹`` is symmetric.
    """
    L = np.linalg.cholesky(both)
    white = np.linalg.solve(L, np.linalg.solve(L, prior).T)
    return float(np.linalg.eigvalsh(white)[-1])
