"""The figures of the Middlebury stereo benchmark, version 3.

Ref: D. Scharstein, H. Hirschmüller et al., Middlebury Stereo Evaluation SDK 1.6, and the table of
https://vision.middlebury.edu/stereo/eval3/: errors are in pixels of the full size.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any, Final

import numpy as np
from numpy.typing import NDArray

from recon.errors import EvaluationError
from recon.evaluation.disparity import evaluate_disparity
from recon.structures import Disparity, DisparityMetrics, DisparityTruth
from recon.structures.arrays import Float32

HALF_WEIGHT: Final = frozenset({"PianoL", "Playroom", "Playtable", "Shelves", "Vintage"})
"""Scenes that count half in the table's mean: variants, or hard for a single reason."""


@dataclass(frozen=True)
class MiddleburyRules:
    """What a scene says about how results for it are counted.

    Attributes:
        full_size_factor: Full-size pixels per pixel of the truth.
        largest_px: Results are clipped to [0, this], pixels of the truth; None = known to nobody.
        isint: Results are rounded to whole pixels of the truth.
    """

    full_size_factor: float = 1.0
    largest_px: float | None = None
    isint: bool = False


def scene_weight(name: str) -> float:
    """How much a scene counts in the table's mean: 8, or 4 for those of `HALF_WEIGHT`.

    Args:
        name: Name of its folder, or a path that ends in it.
    """
    scene = name.rpartition("/")[2].removesuffix("-perfect").removesuffix("-imperfect")
    return 4.0 if scene in HALF_WEIGHT else 8.0


def at_truth_size(values: Float32, shape: tuple[int, ...]) -> Float32:
    """A result at the size of the truth, its values in pixels of that size.

    A smaller one is enlarged, and of a larger one every second or fourth pixel is taken; nothing
    is interpolated.

    Args:
        values: float32 (h, w), pixels of its own size; NaN = none.
        shape: (H, W) of the truth.

    Returns:
        float32 (H, W).

    Raises:
        EvaluationError: Neither size is 1, 2 or 4 times the other, a row and column less or more.
    """
    step = _step(values.shape, shape)
    return np.asarray(_taken(values, shape, step) / np.float32(step), dtype=np.float32)


def estimate_at_truth_size(estimate: Disparity, shape: tuple[int, ...]) -> tuple[Disparity, float]:
    """`at_truth_size` of all that is known of a result.

    Args:
        estimate: The result.
        shape: (H, W) of the truth.

    Returns:
        The result at that size, and how many pixels of its own size a pixel there is.

    Raises:
        EvaluationError: The sizes do not fit.
    """
    step = _step(estimate.values.shape, shape)
    sized = Disparity(
        values=at_truth_size(estimate.values, shape),
        confidence=_taken(estimate.confidence, shape, step),
        sigma_px=at_truth_size(estimate.sigma_px, shape),
        reason=_taken(estimate.reason, shape, step),
    )
    return sized, step


def by_the_rules(values: Float32, shape: tuple[int, ...], rules: MiddleburyRules) -> Float32:
    """What of a result is compared: float32 (H, W) at the size of the truth, clipped, rounded.

    Args:
        values: float32 (h, w), pixels; NaN = none.
        shape: (H, W) of the truth.
        rules: Of the scene.

    Raises:
        EvaluationError: The sizes do not fit.
    """
    sized = np.clip(at_truth_size(values, shape), np.float32(0), rules.largest_px)
    # The SDK rounds halves up, as C does; numpy rounds them to even.
    return np.asarray(np.floor(sized + np.float32(0.5)) if rules.isint else sized, np.float32)


def evaluate_middlebury(
    values: Float32, truth: DisparityTruth, rules: MiddleburyRules, *, occluded: bool = False
) -> DisparityMetrics:
    """Compare a result with the truth as the benchmark does; figures in full-size pixels.

    Args:
        values: float32 (h, w), pixels; NaN = none. Sparse as found, or dense (holes filled).
        truth: The truth, at this size, or a half, a quarter, twice or four times of it.
        rules: Of the scene.
        occluded: Count the pixels too that only the left camera sees ("all").

    Raises:
        EvaluationError: The sizes do not fit, or no pixel has a known truth.
    """
    compared = by_the_rules(values, truth.values.shape, rules)
    return evaluate_disparity(compared, truth, occluded=occluded, scale=rules.full_size_factor)


def weighted_mean(figures: Mapping[str, float]) -> float:
    """The mean over scenes as the table has it; NaN where one is.

    Args:
        figures: A figure of each scene, by the scene's name.

    Raises:
        EvaluationError: There is no scene.
    """
    if not figures:
        raise EvaluationError("there is no scene to take a mean over")
    weights = np.array([scene_weight(name) for name in figures])
    return float(np.average(np.array(list(figures.values()), dtype=np.float64), weights=weights))


def _step(shape: tuple[int, ...], truth_shape: tuple[int, ...]) -> float:
    """Pixels of a result for each pixel of the truth, along a row: 4, 2, 1, 0.5 or 0.25."""
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
    """The pixel at ``step`` times row and column, whole parts."""
    rows, columns = (
        np.minimum((np.arange(n) * step).astype(np.intp), limit - 1)
        for n, limit in zip(shape, values.shape, strict=True)
    )
    return values[np.ix_(rows, columns)]
