"""Measures of the Middlebury stereo benchmark, version 3; errors are in full-size pixels.

Ref: D. Scharstein, H. Hirschmüller et al., Middlebury Stereo Evaluation SDK 1.6, and the table of
https://vision.middlebury.edu/stereo/eval3/.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any, Final

import numpy as np
from numpy.typing import ArrayLike, NDArray

from recon.core.errors import EvaluationError
from recon.core.values import Disparity, DisparityMetrics, DisparityTruth
from recon.core.values.arrays import Float32
from recon.evaluation.disparity import evaluate_disparity, truth_of, values_of

_HALF_WEIGHT: Final = frozenset({"PianoL", "Playroom", "Playtable", "Shelves", "Vintage"})


@dataclass(frozen=True)
class MiddleburyRules:
    """Rules of a scene for the evaluation of results.

    Attributes:
        full_size_factor: Full-size pixels per pixel of the truth.
        largest_px: Results are clipped to [0, this], pixels of the truth; None = unknown.
        isint: Whether results are rounded to whole pixels of the truth.
    """

    full_size_factor: float = 1.0
    largest_px: float | None = None
    isint: bool = False


def evaluate_middlebury(
    estimate: Disparity | ArrayLike,
    truth: DisparityTruth | ArrayLike,
    rules: MiddleburyRules | None = None,
    *,
    occluded: bool = False,
) -> DisparityMetrics:
    """Compare a result with the truth as the benchmark does; errors are in full-size pixels.

    Args:
        estimate: A disparity, or its values: (h, w), pixels of its own size, not finite = none.
            Sparse as matched, or dense (holes filled).
        truth: Ground truth, at the size of the result or 2 or 4 times larger or smaller; or its
            values as `DisparityTruth.from_values` takes them.
        rules: Rules of the scene; None = errors in pixels of the truth, nothing clipped or
            rounded.
        occluded: Whether to include pixels that only the left camera sees ("all").

    Raises:
        EvaluationError: The sizes do not fit, or no pixel has a known truth.
    """
    known, rules = truth_of(truth), rules or MiddleburyRules()
    compared = values_compared(values_of(estimate), known.values.shape, rules)
    return evaluate_disparity(compared, known, occluded=occluded, scale=rules.full_size_factor)


def values_compared(values: Float32, shape: tuple[int, ...], rules: MiddleburyRules) -> Float32:
    """Return a result as it is compared: at the size (H, W) of the truth, clipped, rounded."""
    sized = np.clip(at_truth_size(values, shape), np.float32(0), rules.largest_px)
    # The SDK rounds halves up, as C does; numpy rounds them to even.
    return np.asarray(np.floor(sized + np.float32(0.5)) if rules.isint else sized, np.float32)


def at_truth_size(values: Float32, shape: tuple[int, ...]) -> Float32:
    """Return float32 (H, W), a result at the size of the truth, in pixels of that size.

    Pixels are repeated or skipped, never interpolated.
    """
    step = _step(values.shape, shape)
    return np.asarray(_taken(values, shape, step) / np.float32(step), dtype=np.float32)


def estimate_at_truth_size(estimate: Disparity, shape: tuple[int, ...]) -> tuple[Disparity, float]:
    """Return a result as `at_truth_size` does, and its original pixels per pixel of the truth."""
    step = _step(estimate.values.shape, shape)
    sized = Disparity(
        values=at_truth_size(estimate.values, shape),
        confidence=_taken(estimate.confidence, shape, step),
        sigma_px=at_truth_size(estimate.sigma_px, shape),
        reason=_taken(estimate.reason, shape, step),
    )
    return sized, step


def scene_weight(name: str) -> float:
    """Return what a scene counts for in the table's mean: 4 if it is a variant or hard, else 8.

    ``name`` is that of its folder, or a path that ends in it.
    """
    scene = name.rpartition("/")[2].removesuffix("-perfect").removesuffix("-imperfect")
    return 4.0 if scene in _HALF_WEIGHT else 8.0


def weighted_mean(figures: Mapping[str, float]) -> float:
    """Return the mean over scenes, weighted as in the table; NaN if any value is NaN."""
    weights = [scene_weight(name) for name in figures]
    return float(np.average(np.array(list(figures.values()), dtype=np.float64), weights=weights))


def _step(shape: tuple[int, ...], truth_shape: tuple[int, ...]) -> float:
    """Return pixels of a result for each pixel of the truth, along a row: 4, 2, 1, 0.5 or 0.25."""
    for factor in (1, 2, 4):
        if _fits(truth_shape, shape, factor):
            return 1 / factor
        if _fits(shape, truth_shape, factor):
            return factor
    raise EvaluationError(
        "result and truth differ in size",
        got=f"{shape[1]}x{shape[0]} against {truth_shape[1]}x{truth_shape[0]}",
        expected="one 1, 2 or 4 times the other",
    )


def _fits(large: tuple[int, ...], small: tuple[int, ...], factor: int) -> bool:
    return all(abs(a - b * factor) < factor for a, b in zip(large, small, strict=True))


def _taken(values: NDArray[Any], shape: tuple[int, ...], step: float) -> NDArray[Any]:
    """Return the pixels at ``step`` times row and column, rounded down."""
    rows, columns = (
        np.minimum((np.arange(n) * step).astype(np.intp), limit - 1)
        for n, limit in zip(shape, values.shape, strict=True)
    )
    return values[np.ix_(rows, columns)]
