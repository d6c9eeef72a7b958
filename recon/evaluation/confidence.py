"""Calibration of confidences and standard deviations, measured against ground truth."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Final

import numpy as np

from recon.core.errors import EvaluationError
from recon.core.values import Disparity, DisparityTruth
from recon.core.values.arrays import Bool, Float32, Float64, freeze
from recon.evaluation.disparity import compared_pixels

_BINS: Final = 10  # equal bins of confidence between 0 and 1
_STEPS: Final = 100  # points of a sparsification curve


@dataclass(frozen=True, eq=False)
class Reliability:
    """Reliability diagram: share of correct pixels for each level of confidence."""

    edges: Float64  # (B + 1,), limits of the bins, from 0 to 1
    confidence: Float64  # (B,), mean confidence in the bin; NaN = empty bin
    right: Float64  # (B,), share of correct pixels in the bin; NaN = empty bin
    pixels: Float64  # (B,), number of pixels in the bin

    def __post_init__(self) -> None:
        freeze(self, "edges", np.float64, (None,))
        for name in ("confidence", "right", "pixels"):
            freeze(self, name, np.float64, (len(self.edges) - 1,))

    @property
    def calibration_error(self) -> float:
        """Expected calibration error in [0, 1]: mean ``|confidence - right|`` over all pixels."""
        gaps = np.nan_to_num(np.abs(self.confidence - self.right))
        return float(np.average(gaps, weights=self.pixels))


@dataclass(frozen=True, eq=False)
class Sparsification:
    """Sparsification curve: share of wrong pixels left as the least confident ones are removed."""

    removed: Float64  # (N,), share of removed pixels, from 0 to below 1
    wrong: Float64  # (N,), share of wrong pixels among the rest, if removed by confidence
    best: Float64  # (N,), the same if the wrong pixels are removed first: the optimum

    def __post_init__(self) -> None:
        freeze(self, "removed", np.float64, (None,))
        for name in ("wrong", "best"):
            freeze(self, name, np.float64, self.removed.shape)

    @property
    def ause(self) -> float:
        """Area between the two curves in [0, 1]; 0 = the confidence ranks pixels perfectly."""
        return float(np.mean(self.wrong - self.best))


def measure_reliability(
    estimate: Disparity, truth: DisparityTruth, limit_px: float = 1.0
) -> Reliability:
    """Compare the confidence of pixels with the share of them that is correct.

    ``limit_px`` is the largest error of a correct pixel; occluded ones count too.

    Ref: C. Guo et al., "On calibration of modern neural networks", ICML 2017, section 2.
    """
    both, error_px = _pixels(estimate, truth)
    confidence = estimate.confidence[both]
    right = error_px <= limit_px
    place = np.minimum((confidence.astype(np.float64) * _BINS).astype(np.int64), _BINS - 1)
    pixels = np.bincount(place, minlength=_BINS).astype(np.float64)
    with np.errstate(invalid="ignore"):
        return Reliability(
            edges=np.linspace(0, 1, _BINS + 1),
            confidence=np.bincount(place, weights=confidence, minlength=_BINS) / pixels,
            right=np.bincount(place, weights=right, minlength=_BINS) / pixels,
            pixels=pixels,
        )


def measure_sparsification(
    estimate: Disparity, truth: DisparityTruth, limit_px: float = 1.0
) -> Sparsification:
    """Remove the least confident pixels step by step, and measure the share of wrong ones left.

    Among pixels of equal confidence, correct and wrong ones are removed in proportion.

    Ref: E. Ilg et al., "Uncertainty estimates and multi-hypotheses networks for optical flow",
    ECCV 2018, section 4 (sparsification, AUSE).
    """
    both, error_px = _pixels(estimate, truth)
    wrong = (error_px > limit_px).astype(np.float64)
    removed = np.arange(_STEPS) / _STEPS
    kept = np.maximum(np.ceil((1 - removed) * wrong.size).astype(np.int64), 1)
    return Sparsification(
        removed=removed,
        wrong=np.cumsum(_shared_by_equals(estimate.confidence[both], wrong))[kept - 1] / kept,
        best=np.cumsum(np.sort(wrong))[kept - 1] / kept,
    )


def share_within_sigma(estimate: Disparity, truth: DisparityTruth, sigmas: float = 1.0) -> float:
    """Return the share of the pixels, in [0, 1], whose error is within some standard deviations.

    For a normal distribution, it is 0.683 within one and 0.954 within two.
    """
    both, error_px = _pixels(estimate, truth)
    return float(np.mean(error_px < sigmas * estimate.sigma_px[both]))


def _shared_by_equals(confidence: Float32, wrong: Float64) -> Float64:
    """Return wrong pixels in order of decreasing confidence, averaged over equal confidences."""
    _, group, size = np.unique(-confidence, return_inverse=True, return_counts=True)
    share = np.bincount(group, weights=wrong) / size
    return np.asarray(np.repeat(share, size), dtype=np.float64)


def _pixels(estimate: Disparity, truth: DisparityTruth) -> tuple[Bool, Float64]:
    """Return bool (H, W), the pixels with a value and a known truth, and their errors (N,)."""
    both = estimate.valid & compared_pixels(estimate.values, truth, occluded=True)
    if not both.any():
        raise EvaluationError("no pixel has both a disparity and a known truth")
    return both, np.abs(estimate.values[both].astype(np.float64) - truth.values[both])
