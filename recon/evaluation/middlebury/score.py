"""The rules of the Middlebury stereo benchmark, version 3, and the figures of one result.

Errors are in full-size pixels.

Ref: D. Scharstein, H. Hirschmüller et al., Middlebury Stereo Evaluation SDK 1.6, and the table of
https://vision.middlebury.edu/stereo/eval3/.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import asdict, dataclass
from typing import Any, Final

import numpy as np
from numpy.typing import ArrayLike, NDArray

from recon.core.errors import EvaluationError
from recon.core.geometry.alignment import nearest_sorted
from recon.core.values import (
    Disparity,
    DisparityMetrics,
    DisparityTruth,
    RectifiedCamera,
    StereoPair,
)
from recon.core.values.arrays import Bool, Float32, Int32, frozen_array
from recon.evaluation.confidence import (
    measure_reliability,
    measure_sparsification,
    share_within_sigma,
)
from recon.evaluation.disparity import evaluate_depth, evaluate_disparity, truth_of, values_of

# Pixels that are scored: those seen by both cameras, or occluded ones as well.
MASKS: Final = {"nonocc": False, "all": True}
_HALF_WEIGHT: Final = frozenset({"PianoL", "Playroom", "Playtable", "Shelves", "Vintage"})
Figures = dict[str, Any]
_RIGHT_PX: Final = 1.0  # largest error of a correct pixel, in pixels of the result
_KEPT: Final = 5  # every fifth point of a sparsification curve: 20 of 100


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


@dataclass(frozen=True, eq=False)
class ScoredScene:
    """One scene, ready to be matched and scored."""

    name: str  # name of its folder, with parent folders if several scenes share a name
    pair: StereoPair
    camera: RectifiedCamera  # for matching; its ``ndisp`` is set
    truth: DisparityTruth  # at the size of the images or another size
    truth_camera: RectifiedCamera | None  # at the size of the truth; None = not published
    rules: MiddleburyRules


def score_result(scene: ScoredScene, values: Float32) -> Figures:
    """Return the figures of a result, float32 (h, w) in pixels, by mask."""
    maps = {"dense": dense_map(values), "sparse": values}
    return {mask: _of_mask(scene, maps, occluded=occluded) for mask, occluded in MASKS.items()}


def _of_mask(scene: ScoredScene, maps: Mapping[str, Float32], *, occluded: bool) -> Figures:
    figures: Figures = {}
    for name, values in maps.items():
        metrics = evaluate_middlebury(values, scene.truth, scene.rules, occluded=occluded)
        figures[name] = named_figures(metrics)
        if scene.truth_camera is not None:
            compared = values_compared(values, scene.truth.values.shape, scene.rules)
            depth = evaluate_depth(compared, scene.truth, scene.truth_camera, occluded=occluded)
            figures[name]["depth"] = asdict(depth)
        # The sparse map comes last: its holes are what the matcher did not find.
        figures["invalid"] = metrics.invalid
    return figures


def named_figures(metrics: DisparityMetrics) -> Figures:
    """Return figures named as in the benchmark's table, in pixels and per cent."""
    return {
        "bad": {f"{limit:g}": share for limit, share in metrics.bad.items()},
        "avgerr": metrics.avgerr_px,
        "rms": metrics.rms_px,
        **{f"a{percent}": error for percent, error in metrics.quantiles_px.items()},
    }


def confidence_figures(estimate: Disparity, truth: DisparityTruth) -> Figures | None:
    """Return how well the confidence and the standard deviation of a result predict its errors.

    Counts all pixels with a value and known ground truth, occluded ones included; None if there are
    none. The truth may be 2 or 4 times larger or smaller.
    """
    shape = truth.values.shape
    step = _step(estimate.values.shape, shape)  # pixels of the result per pixel of the truth
    sized = Disparity(
        values=at_truth_size(estimate.values, shape),
        confidence=_taken(estimate.confidence, shape, step),
        sigma_px=at_truth_size(estimate.sigma_px, shape),
        reason=_taken(estimate.reason, shape, step),
    )
    if not (sized.valid & np.isfinite(truth.values)).any():
        return None
    shares = {f"within_{n}_sigma": share_within_sigma(sized, truth, n) for n in (1, 2)}
    return {**curve_figures(sized, truth, _RIGHT_PX / step), **shares}


def curve_figures(estimate: Disparity, truth: DisparityTruth, limit_px: float) -> Figures:
    """Return the same for the confidence alone, of maps of equal size."""
    bins = measure_reliability(estimate, truth, limit_px)
    steps = measure_sparsification(estimate, truth, limit_px)
    return {
        "ece": bins.calibration_error,
        "ause": steps.ause,
        "reliability": {
            "confidence": rounded(bins.confidence),
            "right": rounded(bins.right),
            "share": rounded(bins.pixels / bins.pixels.sum()),
        },
        "sparsification": {
            name: rounded(getattr(steps, name)[::_KEPT]) for name in ("removed", "wrong", "best")
        },
    }


def rounded(values: Any) -> list[float | None]:
    """Return values for JSON: six decimals, None for NaN (an empty bin)."""
    return [None if np.isnan(value) else round(float(value), 6) for value in values]


def error_map(scene: ScoredScene, values: Float32) -> Float32:
    """Return float32 (H, W), dense absolute error in full-size pixels; NaN = truth unknown."""
    truth, rules = scene.truth.values, scene.rules
    error = values_compared(dense_map(values), truth.shape, rules) - truth
    return np.asarray(np.abs(error) * np.float32(rules.full_size_factor), dtype=np.float32)


def dense_map(values: Float32) -> Float32:
    """Return a map without holes: float32 (H, W).

    Holes that cannot be filled get disparity 0, which is wrong nearly everywhere, so that no
    matcher gains by leaving pixels out.
    """
    filled = fill_holes(values)
    return np.where(np.isfinite(filled), filled, np.float32(0))


def fill_holes(values: Float32) -> Float32:
    """Give each pixel without a disparity that of the background beside it: float32 (H, W).

    What only one camera sees is hidden behind something nearer, so a hole gets the smaller one of
    the nearest values to the left and to the right on its row, or the only one. A row without any
    value is copied from the nearest row with some, the upper one of two. Known values stay.

    Ref: the background interpolation of A. Geiger et al., KITTI stereo development kit.
    """
    values = frozen_array("values", values, np.float32, (None, None))
    known = np.isfinite(values)
    from_left = _gather(values, _last_known(known))
    from_right = _gather(values[:, ::-1], _last_known(known[:, ::-1]))[:, ::-1]
    filled = np.where(known, values, np.fmin(from_left, from_right))
    rows = np.flatnonzero(known.any(axis=1))
    return filled[rows[nearest_sorted(np.arange(len(filled)), rows)]] if rows.size else filled


def _last_known(known: Bool) -> Int32:
    """Return int32 (H, W): column of the nearest known pixel at or left of each; -1 = none."""
    columns = np.arange(known.shape[1], dtype=np.int32)
    return np.asarray(np.maximum.accumulate(np.where(known, columns, np.int32(-1)), axis=1))


def _gather(values: Float32, columns: Int32) -> Float32:
    there = np.take_along_axis(values, np.maximum(columns, 0).astype(np.intp), axis=1)
    return np.where(columns >= 0, there, np.float32(np.nan))


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
        rules: Rules of the scene; None = errors in pixels of the truth, nothing clipped, rounded.
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


def scene_weight(name: str) -> float:
    """Return what a scene counts for in the table's mean: 4 if it is a variant or hard, else 8.

    ``name`` is that of its folder, or a path that ends in it.
    """
    scene = name.rpartition("/")[2].removesuffix("-perfect").removesuffix("-imperfect")
    return 4.0 if scene in _HALF_WEIGHT else 8.0


def _step(shape: tuple[int, ...], truth_shape: tuple[int, ...]) -> float:
    """Return pixels of a result for each pixel of the truth, along a row: 4, 2, 1, 0.5 or 0.25."""

    def fits(large: tuple[int, ...], small: tuple[int, ...], factor: int) -> bool:
        return all(abs(a - b * factor) < factor for a, b in zip(large, small, strict=True))

    for factor in (1, 2, 4):
        if fits(truth_shape, shape, factor):
            return 1 / factor
        if fits(shape, truth_shape, factor):
            return factor
    raise EvaluationError(
        "result and truth differ in size",
        got=f"{shape[1]}x{shape[0]} against {truth_shape[1]}x{truth_shape[0]}",
        expected="one 1, 2 or 4 times the other",
    )


def _taken(values: NDArray[Any], shape: tuple[int, ...], step: float) -> NDArray[Any]:
    """Return the pixels at ``step`` times row and column, rounded down."""
    rows, columns = (
        np.minimum((np.arange(n) * step).astype(np.intp), limit - 1)
        for n, limit in zip(shape, values.shape, strict=True)
    )
    return values[np.ix_(rows, columns)]
