"""Uncalibrated rectification: rows are aligned, metric scale is unknown."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Final

import cv2
import numpy as np

from recon.core.errors import CalibrationError
from recon.core.geometry.projection import map_pixels
from recon.core.geometry.se3 import exp_so3, hat
from recon.core.values import RectifiedCamera
from recon.core.values.arrays import Float64, UInt8
from recon.core.words import counted
from recon.rig.audit.row_alignment import align_rows
from recon.rig.uncalibrated.fundamental import find_fundamental
from recon.rig.uncalibrated.homographies import Homographies, Size, rectifying_homographies
from recon.stereo.rectify.features import (
    MOST_FEATURES,
    PairFeatures,
    match_again,
    match_exactly,
    pool_features,
)

_INLIER_PX: Final = 1.0  # largest distance of an inlier from its epipolar line
_FEWEST_AT_FIRST: Final = 12
_MIN_FEATURES: Final = 40  # matches that must agree on one geometry
_HELD_OUT: Final = 4  # every fourth feature of a single pair is held out of the fit
_FLAT_SHARE: Final = 0.9  # share of matches on one plane from which the scene counts as flat
_FOCAL_WIDTHS: Final = (0.5, 0.7, 1.0, 1.4, 2.0, 4.0)  # tried: they decide how pitch bends rows
_RESOLVED_PX: Final = 0.5
"""Row error that a simpler model may have more: matching compares whole rows, and half of one is
less than a warped image costs."""


@dataclass(frozen=True, eq=False)
class UncalibratedRectification:
    """Rectifying homographies, and how good they are.

    Attributes:
        model: What aligns the rows: "raw" (nothing to do), "rotation" or "homographies".
        H_left: float64 (3, 3), from raw to rectified pixels.
        H_right: The same for the right image.
        matches: Number of all matches.
        inliers: Number of those that the homographies bring onto one row.
        before_px: Median absolute row error of all matches of all pairs, raw.
        after_px: The same, rectified.
        held_out_px: Mean absolute row error of matches held out of the fit; NaN = too few.
        disparity_px: 1st and 99th percentile of the rectified disparity.
    """

    model: str
    H_left: Float64
    H_right: Float64
    matches: int
    inliers: int
    before_px: float
    after_px: float
    held_out_px: float
    disparity_px: tuple[float, float]

    @property
    def fundamental(self) -> Float64:
        """The fundamental matrix: float64 (3, 3), ``right.T @ F @ left = 0`` for raw pixels."""
        return np.asarray(self.H_right.T @ hat(np.array([1.0, 0.0, 0.0])) @ self.H_left)


def rectify_images(
    pairs: Sequence[tuple[UInt8, UInt8]], count: int = MOST_FEATURES
) -> UncalibratedRectification:
    """Find the simplest change that aligns the rows of images of uncalibrated cameras.

    If homographies are needed, features are matched again in the images that these align.

    Args:
        pairs: uint8 (H, W) left and right, of one pair or of several pairs of one rig.
        count: Maximum number of features per image.
    """
    height, width = pairs[0][0].shape
    matched = [match_exactly(left, right, count) for left, right in pairs]
    # The initial guess may rest on few matches: the second round checks it.
    found = rectify_features(matched, (width, height), _FEWEST_AT_FIRST)
    if found.model != "homographies":
        return found
    H = (found.H_left, found.H_right)
    again = [match_again(left, right, *H, count) for left, right in pairs]
    return rectify_features(again, (width, height))


def rectify_features(
    matched: Sequence[PairFeatures], size: Size, min_features: int = _MIN_FEATURES
) -> UncalibratedRectification:
    """Find the simplest change whose held-out row errors are not clearly above the smallest.

    The images as they are, a small rotation of the right camera and homographies are compared by
    their row errors over held-out pairs (of fewer than four pairs: features).

    Args:
        matched: The matches of each pair.
        size: (width, height) of the images.
        min_features: How many must agree on homographies.
    """
    features = pool_features(matched)
    several = sum(len(each) > 0 for each in matched) >= _HELD_OUT
    pair = np.repeat(np.arange(len(matched)), [len(each) for each in matched])
    block = np.unique(pair, return_inverse=True)[1] if several else np.arange(len(features))
    held = block % 2 == 1 if several else block % _HELD_OUT == 0
    trials, _ = _candidates(features.select(~held), size, _FEWEST_AT_FIRST)
    held_out = {name: _row_errors(H, features.select(held)) for name, H in trials.items()}
    counts = np.bincount(block[held])
    blocks = {
        name: np.bincount(block[held], errors)[counts > 0] / counts[counts > 0]
        for name, errors in held_out.items()
    }
    best = min(blocks.values(), key=lambda each: float(each.sum()))
    fits, refusal = _candidates(features, size, min_features)
    before = _row_errors(fits["raw"], features)
    for name, H in fits.items():
        after = _row_errors(H, features)
        if name not in blocks or _clearly_above(blocks[name], best) or after.sum() > before.sum():
            continue
        # A model that is no homography has to hold for most matches, else there is no geometry.
        enough = 1 if name == "homographies" else max(_MIN_FEATURES, len(features) / 2)
        if (after < _INLIER_PX).sum() >= enough:
            return _result(name, H, features, held_out[name])
    raise refusal or CalibrationError(
        "rows cannot be aligned",
        got=f"{before.mean():.1f} px mean row error as recorded, and no smaller one",
        hint="use more pairs with texture, or a calibration: recon calibrate",
    )


def _candidates(
    features: PairFeatures, size: Size, min_features: int
) -> tuple[dict[str, Homographies], CalibrationError | None]:
    """Return homographies by model, the simplest first; and why the last one is missing."""
    fits = {"raw": (np.eye(3), np.eye(3))}
    turns = [H for share in _FOCAL_WIDTHS if (H := _turned(features, size, share)) is not None]
    if turns:
        fits["rotation"] = min(turns, key=lambda H: float(_row_errors(H, features).mean()))
    try:
        fits["homographies"] = _fit(features, size, min_features)
    except CalibrationError as refusal:
        return fits, refusal
    return fits, None


def _turned(features: PairFeatures, size: Size, focal_widths: float) -> Homographies | None:
    """Return the homographies of the smallest rotation of the right camera that aligns rows."""
    cx, cy, focal = (size[0] - 1) / 2, (size[1] - 1) / 2, focal_widths * size[0]
    camera = RectifiedCamera(focal, cx, cy, cx, 1.0, *size)
    found = align_rows(features.left_uv, features.right_uv, camera)
    if found is None:
        return None
    K = np.array([[focal, 0, cx], [0, focal, cy], [0, 0, 1.0]])
    H = K @ exp_so3(found.turn[:3]) @ np.linalg.inv(K)
    columns = features.left_uv[:, 0] - map_pixels(H, features.right_uv)[:, 0]
    # A matcher searches from 0: cameras that are turned towards each other are shifted apart.
    least = min(0.0, float(np.percentile(columns, 1)))
    return np.eye(3), np.array([[1.0, 0, least], [0, 1, 0], [0, 0, 1]]) @ H


def _fit(features: PairFeatures, size: Size, min_features: int) -> Homographies:
    """Return rectifying homographies of any two pinhole cameras."""
    F, agreeing = find_fundamental(features, _INLIER_PX)
    if F is None or agreeing.sum() < min_features:
        raise CalibrationError(
            "too few matched features agree on one camera geometry",
            got=f"{int(agreeing.sum())} of {counted(len(features), 'match', 'matches')}",
            expected=f"at least {min_features}",
            hint="are these two views of the same scene, with texture?",
        )
    some = features.select(agreeing)
    # A plane does not determine the geometry of the cameras.
    _, mask = cv2.findHomography(some.left_uv, some.right_uv, cv2.USAC_MAGSAC, _INLIER_PX)
    flat_share = 0.0 if mask is None else float(np.mean(mask))
    if flat_share > _FLAT_SHARE:
        raise CalibrationError(
            "the scene is flat and does not determine the camera geometry",
            got=f"{100 * flat_share:.0f} % of the matches on one plane",
            expected=f"at most {100 * _FLAT_SHARE:g} %",
            hint="use a scene with both near and far objects, or calibrate: recon calibrate",
        )
    return rectifying_homographies(F, some, size)


def _row_errors(H: Homographies, features: PairFeatures) -> Float64:
    """Return float64 (N,), absolute row errors of matches; those of false matches are limited."""
    left, right = map_pixels(H[0], features.left_uv), map_pixels(H[1], features.right_uv)
    return np.minimum(np.abs(left[:, 1] - right[:, 1]), 4 * _INLIER_PX)


def _clearly_above(errors: Float64, best: Float64) -> bool:
    """Return whether errors exceed the best by two standard errors and what features resolve."""
    more = errors - best
    deviation = float(more.std(ddof=1)) if len(more) > 1 else 0.0
    return len(more) > 0 and bool(more.mean() > max(2 * deviation / len(more) ** 0.5, _RESOLVED_PX))


def _result(
    model: str, H: Homographies, features: PairFeatures, held_out: Float64
) -> UncalibratedRectification:
    errors = _row_errors(H, features)
    agreeing, good = errors < _INLIER_PX, held_out < 4 * _INLIER_PX
    left, right = map_pixels(H[0], features.left_uv), map_pixels(H[1], features.right_uv)
    low, high = np.percentile((left - right)[agreeing, 0], (1, 99))
    return UncalibratedRectification(
        model=model,
        H_left=H[0],
        H_right=H[1],
        matches=len(features),
        inliers=int(agreeing.sum()),
        before_px=float(np.median(np.abs(features.left_uv - features.right_uv)[:, 1])),
        after_px=float(np.median(errors)),
        held_out_px=float(held_out[good].mean()) if good.any() else float("nan"),
        disparity_px=(float(low), float(high)),
    )
