"""The rules of the Middlebury stereo benchmark, version 3; errors are in full-size pixels.

Ref: D. Scharstein, H. Hirschmüller et al., Middlebury Stereo Evaluation SDK 1.6, and the table of
https://vision.middlebury.edu/stereo/eval3/.
"""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from contextlib import suppress
from dataclasses import asdict, dataclass
from typing import Any, Final

import numpy as np
from numpy.typing import ArrayLike, NDArray

from recon.core.errors import EvaluationError
from recon.core.values import (
    Disparity,
    DisparityMetrics,
    DisparityTruth,
    RectifiedCamera,
    StereoPair,
)
from recon.core.values.arrays import Float32, Float64
from recon.evaluation import disparity as errors
from recon.stereo.match.fill import fill_holes

# Pixels that are scored: those seen by both cameras, or occluded ones as well.
MASKS: Final = {"nonocc": False, "all": True}
_HALF_WEIGHT: Final = frozenset({"PianoL", "Playroom", "Playtable", "Shelves", "Vintage"})
_RIGHT_PX: Final = 1.0  # largest error of a correct pixel, in pixels of the result
_KEPT: Final = 5  # every fifth point of a sparsification curve: 20 of 100
Figures = dict[str, Any]


@dataclass(frozen=True)
class MiddleburyRules:
    """Rules of a scene for the evaluation of results."""

    full_size_factor: float = 1.0  # full-size pixels per pixel of the truth
    largest_px: float | None = None  # clips results to [0, this], px of the truth; None = unknown
    isint: bool = False  # whether results are rounded to whole pixels of the truth


@dataclass(frozen=True, eq=False)
class ScoredScene:
    """One scene, ready to be matched and scored."""

    name: str  # name of its folder, with parent folders if several scenes share a name
    pair: StereoPair
    camera: RectifiedCamera  # for matching; its ``ndisp`` is set
    truth: DisparityTruth  # at the size of the images or another size
    truth_camera: RectifiedCamera | None  # at the size of the truth; None = not published
    rules: MiddleburyRules


def score_result(scene: ScoredScene, estimate: Disparity) -> Figures:
    """Return the figures of a result by mask: with both kinds of pixels, and of each kind alone."""
    truth, camera, factor = scene.truth, scene.truth_camera, scene.rules.full_size_factor
    values, true, pixels = estimate.values, truth.values, dict.fromkeys(MASKS, 0)
    figures: Figures = {mask: {} for mask in MASKS}
    # The sparse map comes last: its holes are what the matcher did not find.
    for name, holed in {"dense": dense_map(values), "sparse": values}.items():
        compared = values_compared(holed, true.shape, scene.rules)
        for mask, occluded in MASKS.items():
            metrics = errors.evaluate_disparity(compared, truth, occluded=occluded, scale=factor)
            figures[mask][name] = named_figures(metrics)
            if camera is not None:
                depth = errors.evaluate_depth(compared, truth, camera, occluded=occluded)
                figures[mask][name]["depth"] = asdict(depth)
            figures[mask]["invalid"], pixels[mask] = metrics.invalid, metrics.pixels
    limits_px = (*errors.THRESHOLDS_PX, errors.WRONG_PX * factor / _step(values.shape, true.shape))
    for kind, alone in kinds_of(estimate).items():
        compared = values_compared(alone.values, true.shape, scene.rules)
        for mask, occluded in MASKS.items():
            figures[mask][kind] = {"ratio": 0.0}
            with suppress(EvaluationError):  # there is no such pixel
                metrics = errors.evaluate_disparity(
                    compared, truth, limits_px, occluded=occluded, scale=factor, kind="measured"
                )
                wrong, ratio = metrics.bad.pop(limits_px[-1]), 100 * metrics.pixels / pixels[mask]
                figures[mask][kind] = {"ratio": ratio, "wrong": wrong, **named_figures(metrics)}
    return figures


def kinds_of(estimate: Disparity) -> dict[errors.Kind, Disparity]:
    """Return what was measured, and what was inferred, each alone."""
    return {"measured": estimate.only_measured(), "inferred": estimate.only_inferred()}


def named_figures(metrics: DisparityMetrics) -> Figures:
    """Return figures named as in the benchmark's table, in pixels and per cent."""
    return {
        "bad": {f"{limit:g}": ratio for limit, ratio in metrics.bad.items()},
        "avgerr": metrics.avgerr_px,
        "rms": metrics.rms_px,
        **{f"a{percent}": error for percent, error in metrics.quantiles_px.items()},
    }


def confidence_figures(estimate: Disparity, truth: DisparityTruth) -> Figures | None:
    """Return how well a result predicts its errors; None if no pixel can be compared.

    All pixels with a value and known truth count. The truth may be 2 or 4 times larger or smaller.
    """
    shape = truth.values.shape
    step = _step(estimate.values.shape, shape)  # pixels of the result per pixel of the truth
    sized = Disparity(
        values=at_truth_size(estimate.values, shape),
        confidence=_taken(estimate.confidence, shape, step),
        sigma_px=at_truth_size(estimate.sigma_px, shape),
        reason=_taken(estimate.reason, shape, step),
    )
    known = np.isfinite(truth.values)
    if not (sized.valid & known).any():
        return None
    ece = {
        f"ece_{kind}": errors.measure_reliability(alone, truth, _RIGHT_PX / step).calibration_error
        for kind, alone in kinds_of(sized).items()
        if (alone.valid & known).any()
    }
    ratios = {f"within_{n}_sigma": errors.ratio_within_sigma(sized, truth, n) for n in (1, 2)}
    return {**curve_figures(sized, truth, _RIGHT_PX / step), **ece, **ratios}


def curve_figures(estimate: Disparity, truth: DisparityTruth, limit_px: float) -> Figures:
    """Return the same for the confidence alone, of maps of equal size."""
    bins = errors.measure_reliability(estimate, truth, limit_px)
    steps = errors.measure_sparsification(estimate, truth, limit_px)
    ratio = bins.pixels / bins.pixels.sum()
    reliability = {"confidence": bins.confidence, "right": bins.right, "ratio": ratio}
    return {
        "ece": bins.calibration_error,
        "ause": steps.ause,
        "reliability": {name: rounded(each) for name, each in reliability.items()},
        "sparsification": {n: rounded(each[::_KEPT]) for n, each in steps._asdict().items()},
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
    """Return a map without holes, float32 (H, W): those that cannot be filled get disparity 0.

    That is wrong nearly everywhere, so that no matcher gains by leaving pixels out.
    """
    filled = fill_holes(values)
    return np.where(np.isfinite(filled), filled, np.float32(0))


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
        truth: Ground truth, at the size of the result or 2 or 4 times larger or smaller; or its
            values (`DisparityTruth.from_values`).
        rules: Rules of the scene; None = errors in pixels of the truth, nothing clipped, rounded.
        occluded: Whether to include pixels that only the left camera sees ("all").

    Raises:
        EvaluationError: The sizes do not fit, or no pixel has a known truth.
    """
    known, rules = errors.truth_of(truth), rules or MiddleburyRules()
    compared = values_compared(errors.values_of(estimate), known.values.shape, rules)
    scale = rules.full_size_factor
    return errors.evaluate_disparity(compared, known, occluded=occluded, scale=scale)


def values_compared(values: Float32, shape: tuple[int, ...], rules: MiddleburyRules) -> Float32:
    """Return a result as it is compared: at the size (H, W) of the truth, clipped, rounded."""
    sized = np.clip(at_truth_size(values, shape), np.float32(0), rules.largest_px)
    # The SDK rounds halves up, as C does; numpy rounds them to even.
    return np.asarray(np.floor(sized + np.float32(0.5)) if rules.isint else sized, np.float32)


def at_truth_size(values: Float32, shape: tuple[int, ...]) -> Float32:
    """Return a result at the size of the truth, in its pixels, which are repeated or skipped."""
    step = _step(values.shape, shape)
    return np.asarray(_taken(values, shape, step) / np.float32(step), dtype=np.float32)


def scene_weight(name: str) -> float:
    """Return what a scene, by its name or path, counts for in the mean: 4 if it is hard, else 8."""
    scene = name.rpartition("/")[2].removesuffix("-perfect").removesuffix("-imperfect")
    return 4.0 if scene in _HALF_WEIGHT else 8.0


def weighted_figures(scenes: Mapping[str, Any]) -> Any:
    """Return the mean of nested figures over scenes, without those that any lacks."""
    first = next(iter(scenes.values()))
    if isinstance(first, Mapping):
        return {
            key: weighted_figures({name: one[key] for name, one in scenes.items()})
            for key in first
            if all(key in one for one in scenes.values())
        }
    values = np.array(list(scenes.values()), dtype=np.float64)
    mean = np.average(values, axis=0, weights=_weights(scenes))
    return rounded(mean) if isinstance(first, list) else float(mean)


def weighted_confidence(scenes: Mapping[str, Figures | None]) -> Figures | None:
    """Return the mean over the scenes that have figures, with the benchmark's weights."""
    found = {name: one for name, one in scenes.items() if one is not None}
    if not found:
        return None
    bins = {name: one["reliability"] for name, one in found.items()}
    rest = {name: {**one, "reliability": {}} for name, one in found.items()}
    return {**weighted_figures(rest), "reliability": _pooled(bins)}


def _pooled(scenes: Mapping[str, Figures]) -> Figures:
    """Pool the bins of confidence with the fraction of each scene scaled to its weight."""
    weights, bins = _weights(scenes), scenes.values()
    ratio = np.array([one["ratio"] for one in bins]) * (weights / weights.sum())[:, None]
    total = ratio.sum(axis=0)
    pooled = {}
    for name in ("confidence", "right"):
        values = np.nan_to_num(np.array([one[name] for one in bins], dtype=np.float64))
        with np.errstate(invalid="ignore"):
            pooled[name] = rounded(np.sum(ratio * values, axis=0) / total)
    return {**pooled, "ratio": rounded(total)}


def _weights(scenes: Iterable[str]) -> Float64:
    return np.array([scene_weight(name) for name in scenes])


def _step(shape: tuple[int, ...], truth_shape: tuple[int, ...]) -> float:
    """Return pixels of a result for each pixel of the truth, along a row: 4, 2, 1, 0.5 or 0.25."""
    for factor in (1, 2, 4):
        for step, large, small in ((1 / factor, truth_shape, shape), (factor, shape, truth_shape)):
            if all(abs(a - b * factor) < factor for a, b in zip(large, small, strict=True)):
                return step
    got = f"{shape[1]}x{shape[0]} against {truth_shape[1]}x{truth_shape[0]}"
    expected = "one 1, 2 or 4 times the other"
    raise EvaluationError("result and truth differ in size", got=got, expected=expected)


def _taken(values: NDArray[Any], shape: tuple[int, ...], step: float) -> NDArray[Any]:
    """Return the pixels at ``step`` times row and column, rounded down."""
    rows, columns = (
        np.minimum((np.arange(n) * step).astype(np.intp), limit - 1)
        for n, limit in zip(shape, values.shape, strict=True)
    )
    return values[np.ix_(rows, columns)]
