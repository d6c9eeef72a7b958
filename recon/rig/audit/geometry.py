"""Row errors, swapped cameras and delays, from the features of all sampled pairs together."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Final

import numpy as np

from recon.core.values import RectifiedCamera
from recon.core.values.arrays import Float64
from recon.rig.audit.measures import measure_time_skew
from recon.rig.audit.row_alignment import RowAlignment, align_rows
from recon.rig.audit.sample import Sample
from recon.stereo.rectify.features import PairFeatures, inspect_features, pool_features

# Agreement at a lag, relative to that at lag 0, from which a delay is reported.
_LAG_FACTOR: Final = 1.25

# A larger skew, in frames, is closer to a lag of one frame.
_LARGEST_SKEW: Final = 0.75


MIN_FEATURES: Final = 60
"""Minimum number of features, in all, to judge geometry."""


@dataclass(frozen=True, eq=False)
class Geometry:
    """Stereo geometry measured from the features of a drive.

    Attributes:
        pairs: Number of pairs whose features were matched.
        features: Features of all pairs; if one camera is delayed, of pairs shifted by the lag.
        matched: Number of features matched in pairs as recorded.
        alignment: Row errors; None if there are too few features.
        disparity_px: float64 (M,), of the features whose rows agree; 0 is at infinity.
        swapped_share: Share of near features that lie farther right in the right image; NaN if
            there are too few.
        lag: Delay of the right camera in whole frames.
        skew: Its delay as a fraction of a frame, and the standard error; None if there is too
            little motion, or if the delay is whole frames.
    """

    pairs: int
    features: PairFeatures
    matched: int
    alignment: RowAlignment | None
    disparity_px: Float64
    swapped_share: float
    lag: int
    skew: tuple[float, float] | None


def measure_geometry(sample: Sample, camera: RectifiedCamera) -> Geometry:
    """Measure the geometry from the features of all pairs."""
    features = pool_features(sample.features)
    matched = len(features)
    alignment = _align(features, camera)
    skew = _time_skew(sample.features, sample.flows, camera, alignment)
    lag = _best_lag(sample, skew, camera)
    if lag:
        features, skew = pool_features(found for found, _ in sample.lagged[lag]), None
        alignment = _align(features, camera)
    swapped = inspect_features(features, camera.doffs_px, MIN_FEATURES).negative_share
    disparity = _disparities(features, alignment, camera)
    return Geometry(
        len(sample.features), features, matched, alignment, disparity, swapped, lag, skew
    )


def _align(features: PairFeatures, camera: RectifiedCamera) -> RowAlignment | None:
    if len(features) < MIN_FEATURES:
        return None
    alignment = align_rows(features.left_uv, features.right_uv, camera)
    enough = alignment is not None and alignment.agreeing >= MIN_FEATURES
    return alignment if enough else None


def _disparities(
    features: PairFeatures, alignment: RowAlignment | None, camera: RectifiedCamera
) -> Float64:
    """Return float64 (M,), pixels; matches with a large row error are left out."""
    if alignment is None:
        return np.zeros(0)
    rows = alignment.turned_rows(features.right_uv, camera) - features.left_uv[:, 1]
    shift = features.left_uv[:, 0] - features.right_uv[:, 0] + camera.doffs_px
    return shift[np.abs(rows) < max(1.0, 3 * alignment.residual_px)].astype(np.float64)


def _best_lag(sample: Sample, skew: tuple[float, float] | None, camera: RectifiedCamera) -> int:
    """Return the lag that fits best, if it fits clearly better than none.

    A delay of half a frame fits both neighbours badly and is reported as skew, not as lag: what
    moves tells the two apart, where it is seen at that lag.
    """
    if not sample.by_lag:
        return 0
    # Lags were tried on different numbers of pairs.
    fit = {lag: n / len(sample.lagged[lag]) for lag, n in sample.by_lag.items()}
    best = max(fit, key=lambda lag: (fit[lag], -abs(lag)))
    if abs(best) == 1:
        found, flows = zip(*sample.lagged[best], strict=True)
        left = _time_skew(found, flows, camera, _align(pool_features(found), camera))
        if left is not None:
            return best if abs(left[0]) < 1 - _LARGEST_SKEW else 0
    between = skew is not None and 4 * skew[1] < abs(skew[0]) < _LARGEST_SKEW
    if abs(best) == 1 and between:
        return 0
    return best if fit[best] > _LAG_FACTOR * fit.get(0, 0.0) else 0


def _time_skew(
    pairs: Sequence[PairFeatures],
    flows: Sequence[Float64],
    camera: RectifiedCamera,
    alignment: RowAlignment | None,
) -> tuple[float, float] | None:
    """Return the skew in frames with its standard error, from features of pairs and their flow."""
    if alignment is None:
        return None
    errors, moving = [np.zeros(0)], [np.zeros(0)]
    for features, flow in zip(pairs, flows, strict=True):
        rows = alignment.turned_rows(features.right_uv, camera) - features.left_uv[:, 1]
        # The skew is at most half a frame, so a larger row error means a wrong match.
        known = np.isfinite(flow) & (np.abs(rows) < 1.5 + 0.5 * np.abs(flow))
        errors.append(rows[known])
        moving.append(flow[known])
    return measure_time_skew(np.concatenate(errors), np.concatenate(moving))
