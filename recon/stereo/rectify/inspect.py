"""Check that two images are a rectified pair: swapped cameras, misaligned rows.

A stereo matcher searches along one row, in one direction. Given swapped or misaligned images it
fails silently or, worse, finds wrong matches. Features matched over the whole image reveal both.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Final

import numpy as np

from recon.core.errors import CalibrationError
from recon.core.values import RectifiedPair
from recon.core.values.arrays import Bool, Float32
from recon.core.words import counted
from recon.stereo.rectify.features import PairFeatures, match_features

_NEAR_PX: Final = 1.0
"""Features with a smaller disparity are too far away to show whether the cameras are swapped."""

_OUTLIER_PX: Final = 3.0
"""A feature whose row error differs from that of the others by more than this is a wrong match."""


_FEATURES: Final = 1000
"""Maximum number of features per image."""

_MIN_FEATURES: Final = 40
"""With fewer matched features there is no verdict."""

_WARN_ROW_PX: Final = 1.0
"""Median row error that gives a warning, in pixels."""

_SWAPPED_SHARE: Final = 0.8
"""Share of near features with negative disparity from which the cameras count as swapped."""


@dataclass(frozen=True)
class PairInspection:
    """How well a pair is rectified, from features matched over the whole image. NaN = unknown.

    Attributes:
        features: Number of matched features that agree on one row error.
        row_error_px: Median of right minus left row; 0 if the rows are aligned.
        row_spread_px: Robust standard deviation of that (from the median absolute deviation).
        near: Number of features near enough to show whether the cameras are swapped.
        negative_share: Share of those with a negative disparity: about 0, or about 1 if the
            cameras are swapped.
    """

    features: int
    row_error_px: float
    row_spread_px: float
    near: int
    negative_share: float


def inspect_pair(pair: RectifiedPair) -> PairInspection:
    """Measure how well a pair that should be rectified is."""
    features = match_features(pair.left, pair.right, _FEATURES)
    return inspect_features(features, pair.camera.doffs_px)


def inspect_features(
    features: PairFeatures, doffs_px: float = 0.0, min_features: int = _MIN_FEATURES
) -> PairInspection:
    """Measure how well matched features fit a rectified pair.

    Args:
        features: Matches of one pair, or of several pairs of one rig.
        doffs_px: ``cx_right - cx_left``, added to disparities so that 0 is at infinity.
        min_features: With fewer features, the measures are NaN.
    """
    shift = features.right_uv - features.left_uv
    agree = _agreeing(shift[:, 1])
    rows, disparity = shift[agree, 1], doffs_px - shift[agree, 0]
    near = np.abs(disparity) > _NEAR_PX
    known = len(rows) >= min_features
    middle = float(np.median(rows)) if known else float("nan")
    spread = 1.4826 * float(np.median(np.abs(rows - middle))) if known else float("nan")
    enough = near.sum() >= min_features
    negative = float(np.mean(disparity[near] < 0)) if enough else float("nan")
    return PairInspection(len(rows), middle, spread, int(near.sum()), negative)


def check_inspection(inspection: PairInspection, where: str | None = None) -> tuple[str, ...]:
    """Return warnings about a pair; none if it is good or has too few features."""
    if inspection.negative_share >= _SWAPPED_SHARE:
        raise CalibrationError(
            "left and right images are swapped",
            where=where,
            got=f"{100 * inspection.negative_share:.0f} % of {counted(inspection.near, 'feature')} "
            "farther right in the right image",
            expected="farther left",
            hint="give the left camera's images first (or un-mirror the images)",
        )
    if abs(inspection.row_error_px) >= _WARN_ROW_PX:
        line = (
            "rows of left and right are not aligned: the right image is "
            f"{abs(inspection.row_error_px):.0f} px too {_side(inspection.row_error_px)} (expected "
            f"under {_WARN_ROW_PX:g} px); depth will be poor or wrong: rectify the "
            "images, or recalibrate the cameras"
        )
        return (line,)
    return ()


def _side(row_error_px: float) -> str:
    return "low" if row_error_px > 0 else "high"


def _agreeing(row_shift: Float32) -> Bool:
    """Return bool (N,), features whose row error is close to the most common one."""
    if not len(row_shift):
        return np.zeros(0, np.bool_)
    ordered = np.sort(row_shift)
    until = np.searchsorted(ordered, ordered + 2 * _OUTLIER_PX, side="right")
    first = int(np.argmax(until - np.arange(len(ordered))))
    middle = np.median(ordered[first : until[first]])
    return np.asarray(np.abs(row_shift - middle) <= _OUTLIER_PX)
