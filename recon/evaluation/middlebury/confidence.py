"""Quality of matcher confidence: the figures, as ``summary.json`` holds them."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any, Final

import numpy as np

from recon.core.values import Disparity, DisparityTruth
from recon.evaluation.confidence import (
    Reliability,
    Sparsification,
    measure_reliability,
    measure_sparsification,
    share_within_sigma,
)
from recon.evaluation.middlebury.rules import estimate_at_truth_size, scene_weight, weighted_mean

Figures = dict[str, Any]

_RIGHT_PX: Final = 1.0
"""Largest error of a correct pixel, in pixels of the result."""

_KEPT: Final = 5
"""Every fifth point of a sparsification curve is kept: 20 of 100."""

_MEANS: Final = ("ece", "ause", "within_1_sigma", "within_2_sigma")


def confidence_figures(estimate: Disparity, truth: DisparityTruth) -> Figures | None:
    """Return how well the confidence and the standard deviation of a result predict its errors.

    Counts all pixels with a value and known ground truth, occluded ones included.

    Args:
        estimate: The result.
        truth: Ground truth at the same size, or at 2, 4, 1/2 or 1/4 times it.

    Returns:
        The figures, or None if no pixel can be compared.

    Raises:
        EvaluationError: The sizes do not match.
    """
    sized, step = estimate_at_truth_size(estimate, truth.values.shape)
    if not (sized.valid & np.isfinite(truth.values)).any():
        return None
    shares = {f"within_{n}_sigma": share_within_sigma(sized, truth, n) for n in (1, 2)}
    return {**curve_figures(sized, truth, _RIGHT_PX / step), **shares}


def curve_figures(estimate: Disparity, truth: DisparityTruth, limit_px: float) -> Figures:
    """Return the same for the confidence alone, of maps of equal size.

    Raises:
        EvaluationError: The sizes differ, or no pixel can be compared.
    """
    reliability = measure_reliability(estimate, truth, limit_px)
    sparsification = measure_sparsification(estimate, truth, limit_px)
    return {
        "ece": reliability.calibration_error,
        "ause": sparsification.ause,
        "reliability": _of_bins(reliability),
        "sparsification": _of_steps(sparsification),
    }


def weighted_confidence(scenes: Mapping[str, Figures | None]) -> Figures | None:
    """Return the mean over scenes with the benchmark's weights; None if no scene has figures.

    Args:
        scenes: Figures by scene name; scenes with None are skipped.
    """
    found = {name: one for name, one in scenes.items() if one is not None}
    if not found:
        return None
    means = {key: weighted_mean({name: one[key] for name, one in found.items()}) for key in _MEANS}
    weights = np.array([scene_weight(name) for name in found])
    ones = list(found.values())
    return {
        **means,
        "reliability": _pooled_bins([one["reliability"] for one in ones], weights),
        "sparsification": _mean_steps([one["sparsification"] for one in ones], weights),
    }


def _of_bins(reliability: Reliability) -> Figures:
    """Return equal bins of confidence from 0 to 1; None in an empty bin."""
    return {
        "confidence": _rounded(reliability.confidence),
        "right": _rounded(reliability.right),
        "share": _rounded(reliability.pixels / reliability.pixels.sum()),
    }


def _of_steps(sparsification: Sparsification) -> Figures:
    curves = ("removed", "wrong", "best")
    return {name: _rounded(getattr(sparsification, name)[::_KEPT]) for name in curves}


def _pooled_bins(bins: Sequence[Figures], weights: Any) -> Figures:
    """Pool the bins with the share of each scene scaled to its weight."""
    share = np.array([one["share"] for one in bins]) * (weights / weights.sum())[:, None]
    total = share.sum(axis=0)
    pooled: Figures = {}
    for name in ("confidence", "right"):
        values = np.array([one[name] for one in bins], dtype=np.float64)
        sums = np.sum(share * np.nan_to_num(values), axis=0)
        with np.errstate(invalid="ignore"):
            pooled[name] = _rounded(sums / total)
    return {**pooled, "share": _rounded(total)}


def _mean_steps(steps: Sequence[Figures], weights: Any) -> Figures:
    return {
        name: _rounded(np.average([one[name] for one in steps], axis=0, weights=weights))
        for name in steps[0]
    }


def _rounded(values: Any) -> list[float | None]:
    """Return values for JSON: six decimals, None for NaN."""
    return [None if np.isnan(value) else round(float(value), 6) for value in values]
