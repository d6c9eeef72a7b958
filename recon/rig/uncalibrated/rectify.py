"""Uncalibrated rectification by two homographies: rows are aligned, metric scale is unknown."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Final

import cv2
import numpy as np

from recon.core.errors import CalibrationError
from recon.core.geometry.projection import map_pixels
from recon.core.values.arrays import Float64, UInt8
from recon.rig.uncalibrated.fundamental import epipoles, find_fundamental, level_homographies
from recon.rig.uncalibrated.shaping import shape_views
from recon.stereo.rectify.features import (
    MOST_FEATURES,
    PairFeatures,
    match_again,
    match_exactly,
    pool_features,
)

Size = tuple[int, int]

# Largest ratio of the homogeneous scales at two corners of an image.
_MOST_STRETCHED: Final = 20.0
_FEWEST_AT_FIRST: Final = 12
_HELD_OUT: Final = 4  # every fourth feature is held out of the fit and measures its error


_MIN_FEATURES: Final = 40
"""Minimum number of matches that agree on one geometry."""

_INLIER_PX: Final = 1.0
"""Largest distance of an inlier from its epipolar line."""

_FLAT_SHARE: Final = 0.9
"""Share of matches on one plane from which the scene counts as flat."""

_MAX_ROW_PX: Final = 2.0
"""Largest mean row error of an accepted result."""


@dataclass(frozen=True, eq=False)
class UncalibratedRectification:
    """Rectifying homographies, and how good they are.

    Attributes:
        H_left: float64 (3, 3), from raw to rectified pixels.
        H_right: The same for the right image.
        fundamental: float64 (3, 3), ``right.T @ F @ left = 0`` for raw pixels.
        features: The inlier matches, raw pixels.
        matches: Number of all matches.
        rows_px: float64 (N,), left minus right row of each of ``features``, rectified.
        held_out_px: Mean absolute row error of matches held out of the fit; NaN = too few.
        disparity_px: 1st and 99th percentile of the rectified disparity.
    """

    H_left: Float64
    H_right: Float64
    fundamental: Float64
    features: PairFeatures
    matches: int
    rows_px: Float64
    held_out_px: float
    disparity_px: tuple[float, float]


def rectify_images(
    pairs: Sequence[tuple[UInt8, UInt8]], count: int = MOST_FEATURES
) -> UncalibratedRectification:
    """Find homographies that align the rows of images of uncalibrated cameras.

    Features are matched twice: in the raw images, and in the images aligned by the first result.

    Args:
        pairs: uint8 (H, W) left and right, of one pair or of several pairs of one rig.
        count: Maximum number of features per image.

    Raises:
        CalibrationError: See `rectify_uncalibrated`.
    """
    height, width = pairs[0][0].shape
    matched = pool_features(match_exactly(left, right, count) for left, right in pairs)
    # The initial guess may rest on few matches: the second round checks it.
    H = _fit(matched, (width, height), _FEWEST_AT_FIRST)[:2]
    again = pool_features(match_again(left, right, *H, count) for left, right in pairs)
    return rectify_uncalibrated(again, (width, height))


def rectify_uncalibrated(features: PairFeatures, size: Size) -> UncalibratedRectification:
    """Find homographies that align the rows of matches of uncalibrated cameras.

    The fundamental matrix is estimated robustly (MAGSAC++), refined on its inliers, and converted
    to homographies (Hartley). Their remaining degrees of freedom are chosen for little distortion
    and positive disparities.

    Raises:
        CalibrationError: Too few matches agree, the scene is flat, one camera is in the view of
            the other, or a row error remains.

    Ref: Hartley 1999, "Theory and practice of projective rectification".
    """
    used = np.arange(len(features)) % _HELD_OUT != 0
    held_out_px = float("nan")
    if used.sum() >= 2 * _MIN_FEATURES:
        trial = _fit(features.select(used), size, _MIN_FEATURES)
        held_out_px = _held_out(trial[:2], features.select(~used))
    H_left, H_right, F, agreeing = _fit(features, size, _MIN_FEATURES)
    left, right = (
        map_pixels(H, uv) for H, uv in ((H_left, agreeing.left_uv), (H_right, agreeing.right_uv))
    )
    rows = left[:, 1] - right[:, 1]
    if float(np.abs(rows).mean()) > _MAX_ROW_PX:
        raise CalibrationError(
            "rows cannot be aligned",
            got=f"{np.abs(rows).mean():.1f} px mean row error",
            expected=f"at most {_MAX_ROW_PX:g} px",
            hint="lenses with distortion need a calibration: recon calibrate",
        )
    low, high = np.percentile(left[:, 0] - right[:, 0], (1, 99))
    return UncalibratedRectification(
        H_left=H_left,
        H_right=H_right,
        fundamental=F,
        features=agreeing,
        matches=len(features),
        rows_px=rows,
        held_out_px=held_out_px,
        disparity_px=(float(low), float(high)),
    )


def _fit(
    features: PairFeatures, size: Size, min_features: int
) -> tuple[Float64, Float64, Float64, PairFeatures]:
    """Return homographies, the fundamental matrix, and the matches that agree with it."""
    F, agreeing = _fundamental(features, min_features)
    _check_depth(agreeing)
    _check_epipoles(F, size)
    H_left, H_right = shape_views(*level_homographies(F, size), agreeing, size)
    _check_torn(H_left, H_right, size)
    return H_left, H_right, F, agreeing


def _fundamental(features: PairFeatures, min_features: int) -> tuple[Float64, PairFeatures]:
    left, right = features.left_uv.astype(np.float64), features.right_uv.astype(np.float64)
    F, agreeing = find_fundamental(left, right, _INLIER_PX)
    if F is None or agreeing.sum() < min_features:
        raise CalibrationError(
            "too few matched features agree on one camera geometry",
            got=f"{int(agreeing.sum())} of {len(features)} matches",
            expected=f"at least {min_features}",
            hint="are these two views of the same scene, with texture?",
        )
    return F, features.select(agreeing)


def _check_epipoles(F: Float64, size: Size) -> None:
    """Raise if an epipole is inside an image, which no homography can rectify."""
    for side, epipole in zip(("left", "right"), epipoles(F), strict=True):
        with np.errstate(divide="ignore", invalid="ignore"):
            x, y = epipole[:2] / epipole[2]
        if 0 <= x < size[0] and 0 <= y < size[1]:
            raise _seen(side, f"epipole at ({x:.0f}, {y:.0f}) px")


def _check_torn(H_left: Float64, H_right: Float64, size: Size) -> None:
    """Raise if an epipole is so close to an image that pixels would be stretched extremely."""
    w, h = size[0] - 1.0, size[1] - 1.0
    corners = np.array([[0, 0, 1], [w, 0, 1], [w, h, 1], [0, h, 1]])
    for side, H in (("left", H_left), ("right", H_right)):
        last = corners @ H[2]
        if last.min() < last.max() / _MOST_STRETCHED:
            raise _seen(side, "epipole close to its border")


def _seen(side: str, got: str) -> CalibrationError:
    return CalibrationError(
        f"the {side} image sees the other camera: one is in front of the other",
        got=got,
        expected="outside the image",
        hint="put the cameras side by side",
    )


def _held_out(homographies: tuple[Float64, Float64], features: PairFeatures) -> float:
    """Return the mean absolute row error of held-out matches, without outliers; NaN = none."""
    H_left, H_right = homographies
    left, right = map_pixels(H_left, features.left_uv), map_pixels(H_right, features.right_uv)
    rows = np.abs(left[:, 1] - right[:, 1])
    good = rows < 4 * _INLIER_PX
    return float(rows[good].mean()) if good.any() else float("nan")


def _check_depth(features: PairFeatures) -> None:
    """Raise if the scene is planar: this does not determine the geometry of the cameras."""
    _, mask = cv2.findHomography(features.left_uv, features.right_uv, cv2.USAC_MAGSAC, _INLIER_PX)
    share = 0.0 if mask is None else float(np.mean(mask))
    if share > _FLAT_SHARE:
        raise CalibrationError(
            "the scene is flat and does not determine the camera geometry",
            got=f"{100 * share:.0f} % of the matches on one plane",
            expected=f"at most {100 * _FLAT_SHARE:g} %",
            hint="use a scene with both near and far objects, or calibrate: recon calibrate",
        )
