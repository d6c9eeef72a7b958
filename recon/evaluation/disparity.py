"""Errors of disparity maps, as Middlebury and KITTI measure them, and of their confidences."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Final, Literal, NamedTuple

import numpy as np
from numpy.typing import ArrayLike

from recon.core.errors import EvaluationError
from recon.core.values import (
    DepthMetrics,
    Disparity,
    DisparityMetrics,
    DisparityTruth,
    RectifiedCamera,
)
from recon.core.values.arrays import Bool, Float32, Float64, float_map
from recon.core.values.camera import depth_from_disparity

THRESHOLDS_PX: Final = (0.5, 1.0, 2.0, 4.0)
Kind = Literal["all", "measured", "inferred"]
KINDS: Final[tuple[Kind, ...]] = ("measured", "inferred")
WRONG_PX: Final = 3.0  # errors above say that another surface was found
_QUANTILES: Final = (50, 90, 95, 99)
_D1_PX, _D1_SHARE = 3.0, 0.05
_DEPTH_RATIO: Final = 0.05


def evaluate_disparity(
    estimate: Disparity | ArrayLike,
    truth: DisparityTruth | ArrayLike,
    thresholds_px: Sequence[float] = THRESHOLDS_PX,
    *,
    occluded: bool = False,
    scale: float = 1.0,
    kind: Kind = "all",
) -> DisparityMetrics:
    """Compare a disparity map with the truth, over the pixels whose truth is known.

    ``bad[t]`` is the percentage of all compared pixels with an error above ``t``; pixels without a
    value count as invalid and not as bad, so ``bad + invalid`` are all failures.

    Args:
        estimate: A disparity, or its values: (H, W), pixels, not finite = none.
        truth: Ground truth of that size, or its values (`DisparityTruth.from_values`).
        thresholds_px: Thresholds of ``bad``, in pixels at the scale of the results.
        occluded: Whether to include pixels that only the left camera sees.
        scale: Pixels of the results per pixel of the map, such as 4 for quarter-size maps.
        kind: Compare pixels of one kind alone, of which none is invalid.

    Raises:
        EvaluationError: The sizes differ, there is no such kind, or no pixel has a known truth.

    Ref: Scharstein et al., Middlebury Stereo Evaluation SDK 1.6, ``evaldisp``; A. Geiger et al.,
    KITTI stereo development kit (2015), ``d1``.
    """
    values, true = _compared(_alone(estimate, kind), truth, occluded=occluded)
    known = np.isfinite(values)
    pixels = len(values) if kind == "all" else int(known.sum())
    if not pixels:
        raise EvaluationError(f"no {kind} pixel has a known truth to compare with")
    error, true = scale * np.abs(values - true)[known], scale * true[known]
    outlier = (error > _D1_PX) & (error > _D1_SHARE * np.abs(true))
    return DisparityMetrics(
        bad={float(t): 100 * float(np.sum(error > t)) / pixels for t in thresholds_px},
        invalid=100 * (1 - len(error) / pixels),
        avgerr_px=_mean(error),
        rms_px=_mean(error**2) ** 0.5,
        pixels=pixels,
        quantiles_px={q: _quantile(error, q) for q in _QUANTILES},
        d1=100 * float(np.sum(outlier)) / pixels,
    )


def evaluate_kinds(estimate: Disparity, truth: DisparityTruth) -> dict[Kind, DisparityMetrics]:
    """Compare each kind of pixel alone; a kind of which no pixel has a known truth is left out."""
    counted = compared_pixels(estimate.values, truth, occluded=False)
    masks = zip(KINDS, (estimate.measured, estimate.inferred), strict=True)
    there = [kind for kind, mask in masks if (mask & counted).any()]
    return {kind: evaluate_disparity(estimate, truth, kind=kind) for kind in there}


def evaluate_depth(
    estimate: Disparity | ArrayLike,
    truth: DisparityTruth | ArrayLike,
    camera: RectifiedCamera,
    *,
    occluded: bool = False,
) -> DepthMetrics:
    """Compare the depth of a disparity map with the true depth, by a camera of their size.

    The other arguments and errors are those of `evaluate_disparity`.
    """
    values, true = _compared(estimate, truth, occluded=occluded)
    true_m = depth_from_disparity(true, camera).astype(np.float64)
    both = np.isfinite(values) & np.isfinite(true_m)
    depth_m, true_m = depth_from_disparity(values[both], camera), true_m[both]
    error_m = np.abs(np.where(np.isnan(depth_m), np.inf, depth_m) - true_m)
    finite = error_m[np.isfinite(error_m)]
    return DepthMetrics(
        mean_m=_mean(finite),
        median_m=_quantile(error_m, 50),
        rms_m=_mean(finite**2) ** 0.5,
        median_percent=100 * _quantile(error_m / true_m, 50),
        over_5_percent=100 * _mean((error_m > _DEPTH_RATIO * true_m).astype(np.float64)),
        infinite=100 * _mean(np.isinf(error_m).astype(np.float64)),
    )


def values_of(estimate: Disparity | ArrayLike) -> Float32:
    """Return the values of an estimate: float32 (H, W)."""
    return estimate.values if isinstance(estimate, Disparity) else float_map("estimate", estimate)


def truth_of(truth: DisparityTruth | ArrayLike) -> DisparityTruth:
    """Return a ground truth, made from its values if need be."""
    return truth if isinstance(truth, DisparityTruth) else DisparityTruth.from_values(truth)


def _compared(
    estimate: Disparity | ArrayLike, truth: DisparityTruth | ArrayLike, *, occluded: bool
) -> tuple[Float64, Float64]:
    """Return float64 (N,) twice, values and truth of the compared pixels."""
    values, known = values_of(estimate), truth_of(truth)
    counted = compared_pixels(values, known, occluded=occluded)
    return values[counted].astype(np.float64), known.values[counted].astype(np.float64)


def _alone(estimate: Disparity | ArrayLike, kind: Kind) -> Disparity | ArrayLike:
    """Return an estimate without the values of the other kind."""
    if kind not in ("all", *KINDS):
        what, expected = "there is no such kind of pixel", ", ".join(("all", *KINDS))
        raise EvaluationError(what, got=kind, expected=expected)
    if isinstance(estimate, Disparity) and kind != "all":
        return estimate.only_measured() if kind == "measured" else estimate.only_inferred()
    return np.full_like(values_of(estimate), np.nan) if kind == "inferred" else estimate


def compared_pixels(values: Float32, truth: DisparityTruth, *, occluded: bool) -> Bool:
    """Return bool (H, W), the pixels that are compared: those whose truth is known."""
    if values.shape != truth.values.shape:
        got, expected = f"disparity {values.shape}", f"{truth.values.shape}"
        raise EvaluationError("disparity and truth differ in size", got=got, expected=expected)
    counted = np.isfinite(truth.values) & (truth.nonocc | occluded)
    if not counted.any():
        raise EvaluationError("no pixel has a known truth to compare with")
    return np.asarray(counted)


def _mean(numbers: Float64) -> float:
    return float(np.mean(numbers)) if len(numbers) else float("nan")


def _quantile(numbers: Float64, percent: int) -> float:
    """Return the smallest number that ``percent`` % of them do not exceed; NaN if empty."""
    if not len(numbers):
        return float("nan")
    rank = max(1, -(-len(numbers) * percent // 100))
    return float(np.partition(numbers, rank - 1)[rank - 1])


_BINS: Final = 10  # equal bins of confidence between 0 and 1
_STEPS: Final = 100  # points of a sparsification curve


class Reliability(NamedTuple):
    """Reliability diagram: fraction of correct pixels for each level of confidence."""

    confidence: Float64  # (B,), mean confidence in the bin; NaN = empty bin
    right: Float64  # (B,), fraction of correct pixels in the bin; NaN = empty bin
    pixels: Float64  # (B,), number of pixels in the bin

    @property
    def calibration_error(self) -> float:
        """Expected calibration error in [0, 1]: mean ``|confidence - right|`` over all pixels."""
        gaps = np.nan_to_num(np.abs(self.confidence - self.right))
        return float(np.average(gaps, weights=self.pixels))


class Sparsification(NamedTuple):
    """Sparsification curve: wrong pixels that are left as the least confident are removed."""

    removed: Float64  # (N,), fraction of removed pixels, from 0 to below 1
    wrong: Float64  # (N,), fraction of wrong pixels among the rest, if removed by confidence
    best: Float64  # (N,), the same if the wrong pixels are removed first: the optimum

    @property
    def ause(self) -> float:
        """Area between the two curves in [0, 1]; 0 = the confidence ranks pixels perfectly."""
        return float(np.mean(self.wrong - self.best))


def measure_reliability(
    estimate: Disparity, truth: DisparityTruth, limit_px: float = 1.0
) -> Reliability:
    """Compare confidence with the fraction of pixels, occluded ones too, that are within the limit.

    Ref: C. Guo et al., "On calibration of modern neural networks", ICML 2017, section 2.
    """
    both, error_px = _pixels(estimate, truth)
    confidence, right = estimate.confidence[both], error_px <= limit_px
    place = np.minimum((confidence.astype(np.float64) * _BINS).astype(np.int64), _BINS - 1)
    pixels = np.bincount(place, minlength=_BINS).astype(np.float64)
    with np.errstate(invalid="ignore"):
        mean, ratio = (np.bincount(place, x, _BINS) / pixels for x in (confidence, right))
    return Reliability(mean, ratio, pixels)


def measure_sparsification(
    estimate: Disparity, truth: DisparityTruth, limit_px: float = 1.0
) -> Sparsification:
    """Remove the least confident pixels step by step; equal ones in proportion.

    Ref: E. Ilg et al., "Uncertainty estimates and multi-hypotheses networks for optical flow", ECCV
    2018, section 4 (sparsification, AUSE).
    """
    both, error_px = _pixels(estimate, truth)
    wrong = (error_px > limit_px).astype(np.float64)
    removed = np.arange(_STEPS) / _STEPS
    kept = np.maximum(np.ceil((1 - removed) * wrong.size).astype(np.int64), 1)
    sure = -estimate.confidence[both]
    _, group, size = np.unique(sure, return_inverse=True, return_counts=True)
    shared = np.repeat(np.bincount(group, weights=wrong) / size, size)
    by_confidence, best = (np.cumsum(each)[kept - 1] / kept for each in (shared, np.sort(wrong)))
    return Sparsification(removed, by_confidence, best)


def ratio_within_sigma(estimate: Disparity, truth: DisparityTruth, sigmas: float = 1.0) -> float:
    """Return the fraction of pixels, in [0, 1], whose error is within some standard deviations."""
    both, error_px = _pixels(estimate, truth)
    return float(np.mean(error_px < sigmas * estimate.sigma_px[both]))


def _pixels(estimate: Disparity, truth: DisparityTruth) -> tuple[Bool, Float64]:
    """Return bool (H, W), the pixels with a value and a known truth, and their errors (N,)."""
    both = estimate.valid & compared_pixels(estimate.values, truth, occluded=True)
    if not both.any():
        raise EvaluationError("no pixel has both a disparity and a known truth")
    return both, np.abs(estimate.values[both].astype(np.float64) - truth.values[both])
