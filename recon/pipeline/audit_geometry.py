"""What the features of all sampled pairs tell together: rows, swapped eyes, late cameras."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Final

import numpy as np

from recon.audit import AuditSettings, RowAlignment, align_rows, measure_time_skew
from recon.pipeline.audit_sample import Sample
from recon.rectification import PairFeatures, inspect_features
from recon.structures import RectifiedCamera
from recon.structures.arrays import Float64

# A late camera fits so much better with frames of another time.
_LAG_FACTOR: Final = 1.25

# A skew beyond is nearer to one whole frame.
_LARGEST_SKEW: Final = 0.75


@dataclass(frozen=True, eq=False)
class Geometry:
    """What the features of a drive tell.

    Attributes:
        pairs: Number of pairs whose features were matched.
        features: Of all of them; where one camera is late, of pairs that are not.
        matched: Number of features that were matched in pairs as they came.
        alignment: Row errors; None where too few features tell.
        disparity_px: float64 (M,), of the features whose rows agree; 0 is infinitely far.
        swapped_share: Near features that lie farther right in the right picture; NaN where too
            few tell.
        lag: Whole frames by which the right camera is late.
        skew: Fraction of a frame by which it is late, and its standard error; None where nothing
            moves enough, or a camera is late by whole frames.
    """

    pairs: int
    features: PairFeatures
    matched: int
    alignment: RowAlignment | None
    disparity_px: Float64
    swapped_share: float
    lag: int
    skew: tuple[float, float] | None


def measure_geometry(sample: Sample, camera: RectifiedCamera, settings: AuditSettings) -> Geometry:
    """Put the features of all pairs together.

    Args:
        sample: What was looked at.
        camera: The rectified camera.
        settings: Limits.
    """
    features = _pool(sample.features)
    matched = len(features)
    alignment = _align(features, camera, settings)
    skew = _time_skew(sample, camera, alignment)
    lag = _best_lag(sample, skew)
    if lag:
        features, skew = _pool(sample.lagged[lag]), None
        alignment = _align(features, camera, settings)
    swapped = inspect_features(features, camera.doffs_px, settings.min_features).negative_share
    disparity = _disparities(features, alignment, camera)
    return Geometry(
        len(sample.features), features, matched, alignment, disparity, swapped, lag, skew
    )


def _pool(found: list[PairFeatures]) -> PairFeatures:
    empty = np.zeros((0, 2), np.float32)
    return PairFeatures(
        np.concatenate([empty, *(features.left_uv for features in found)]),
        np.concatenate([empty, *(features.right_uv for features in found)]),
    )


def _align(
    features: PairFeatures, camera: RectifiedCamera, settings: AuditSettings
) -> RowAlignment | None:
    if len(features) < settings.min_features:
        return None
    alignment = align_rows(features.left_uv, features.right_uv, camera)
    told = alignment is not None and alignment.agreeing >= settings.min_features
    return alignment if told else None


def _disparities(
    features: PairFeatures, alignment: RowAlignment | None, camera: RectifiedCamera
) -> Float64:
    """float64 (M,), pixels; wrong matches are left out by their rows."""
    if alignment is None:
        return np.zeros(0)
    rows = alignment.turned_rows(features.right_uv, camera) - features.left_uv[:, 1]
    shift = features.left_uv[:, 0] - features.right_uv[:, 0] + camera.doffs_px
    return shift[np.abs(rows) < max(1.0, 3 * alignment.residual_px)].astype(np.float64)


def _best_lag(sample: Sample, skew: tuple[float, float] | None) -> int:
    """The lag that fits best, where it fits clearly better than none.

    Half a frame late fits both neighbours badly: then the skew tells, and not the lag.
    """
    if not sample.by_lag:
        return 0
    # Each lag was tried on its own number of pairs.
    fit = {lag: n / len(sample.lagged[lag]) for lag, n in sample.by_lag.items()}
    best = max(fit, key=lambda lag: (fit[lag], -abs(lag)))
    between = skew is not None and 4 * skew[1] < abs(skew[0]) < _LARGEST_SKEW
    if abs(best) == 1 and between:
        return 0
    return best if fit[best] > _LAG_FACTOR * fit.get(0, 0.0) else 0


def _time_skew(
    sample: Sample, camera: RectifiedCamera, alignment: RowAlignment | None
) -> tuple[float, float] | None:
    """Skew in frames with its standard error, from all pairs."""
    if alignment is None:
        return None
    errors, flows = [np.zeros(0)], [np.zeros(0)]
    for features, flow in zip(sample.features, sample.flows, strict=True):
        rows = alignment.turned_rows(features.right_uv, camera) - features.left_uv[:, 1]
        # What is farther off is a wrong match, whatever the skew: half a frame at most.
        known = np.isfinite(flow) & (np.abs(rows) < 1.5 + 0.5 * np.abs(flow))
        errors.append(rows[known])
        flows.append(flow[known])
    return measure_time_skew(np.concatenate(errors), np.concatenate(flows))
