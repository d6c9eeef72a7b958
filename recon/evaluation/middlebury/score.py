"""The figures of one result and of all scenes together, as ``summary.json`` holds them."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import asdict
from typing import Any, Final

import numpy as np

from recon.core.geometry.interpolation import nearest_sorted
from recon.core.values import DisparityMetrics
from recon.core.values.arrays import Bool, Float32, Int32, frozen_array
from recon.evaluation.disparity import evaluate_depth
from recon.evaluation.middlebury.rules import evaluate_middlebury, values_compared, weighted_mean
from recon.evaluation.middlebury.scenes import ScoredScene

MASKS: Final = {"nonocc": False, "all": True}
"""Pixels that are scored: those seen by both cameras, or occluded ones as well."""

Figures = dict[str, Any]


def dense_map(values: Float32) -> Float32:
    """Return a map without holes: float32 (H, W).

    Holes that cannot be filled get disparity 0, which is wrong nearly everywhere, so that no
    matcher gains by leaving pixels out.
    """
    filled = fill_holes(values)
    return np.where(np.isfinite(filled), filled, np.float32(0))


def score_result(scene: ScoredScene, values: Float32) -> Figures:
    """Return the figures of a result, by mask.

    Args:
        scene: The scene.
        values: float32 (h, w), pixels; NaN = none.

    Raises:
        EvaluationError: The size of the result does not match the ground truth.
    """
    maps = {"dense": dense_map(values), "sparse": values}
    return {mask: _of_mask(scene, maps, occluded=occluded) for mask, occluded in MASKS.items()}


def weighted_figures(scenes: Mapping[str, Figures]) -> Figures:
    """Return the mean of each figure over scenes, with the benchmark's weights.

    Args:
        scenes: Nested figures by scene name. A figure that any scene lacks is left out.
    """
    first, *others = scenes.values()
    shared = [key for key in first if all(key in other for other in others)]
    return {key: _weighted({name: one[key] for name, one in scenes.items()}) for key in shared}


def named_figures(metrics: DisparityMetrics) -> Figures:
    """Return figures named as in the benchmark's table, in pixels and per cent."""
    return {
        "bad": {f"{limit:g}": share for limit, share in metrics.bad.items()},
        "avgerr": metrics.avgerr_px,
        "rms": metrics.rms_px,
        **{f"a{percent}": error for percent, error in metrics.quantiles_px.items()},
    }


def _weighted(values: Mapping[str, Any]) -> Any:
    if isinstance(next(iter(values.values())), dict):
        return weighted_figures(values)
    return weighted_mean(values)


def _of_mask(scene: ScoredScene, maps: Mapping[str, Float32], *, occluded: bool) -> Figures:
    figures: Figures = {}
    for name, values in maps.items():
        metrics = evaluate_middlebury(values, scene.truth, scene.rules, occluded=occluded)
        figures[name] = named_figures(metrics) | _depth(scene, values, occluded=occluded)
        # The sparse map comes last: its holes are what the matcher did not find.
        figures["invalid"] = metrics.invalid
    return figures


def _depth(scene: ScoredScene, values: Float32, *, occluded: bool) -> Figures:
    """Return errors in metres, where the scene has a calibration."""
    if scene.truth_camera is None:
        return {}
    compared = values_compared(values, scene.truth.values.shape, scene.rules)
    metrics = evaluate_depth(compared, scene.truth, scene.truth_camera, occluded=occluded)
    return {"depth": asdict(metrics)}


def fill_holes(values: Float32) -> Float32:
    """Give each pixel without a disparity that of the background beside it.

    What only one camera sees is hidden behind something nearer, so a hole gets the smaller one of
    the nearest values to the left and to the right on its row, or the only one. A row without any
    value is copied from the nearest row with some, the upper one of two. Known values stay.

    Args:
        values: float32 (H, W), pixels; NaN = none.

    Returns:
        float32 (H, W); all NaN where ``values`` are, else without NaN.

    Raises:
        ShapeError: The array has another dtype or shape.

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
