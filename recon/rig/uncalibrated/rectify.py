"""Uncalibrated rectification by two homographies: rows are aligned, metric scale is unknown."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Final

import cv2
import numpy as np
from numpy.typing import NDArray

from recon.core.errors import CalibrationError
from recon.core.geometry.projection import map_pixels
from recon.core.geometry.se3 import exp_so3, hat
from recon.core.values import RectifiedCamera
from recon.core.values.arrays import Float64, UInt8
from recon.core.words import counted
from recon.rig.audit.row_alignment import align_rows
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

# Focal lengths that are tried, in image widths: they only decide how pitch bends rows.
_FOCAL_WIDTHS: Final = (0.5, 0.7, 1.0, 1.4, 2.0, 4.0)
_RESOLVED_PX: Final = 0.5
"""Row error that a simpler model may have more: matching compares whole rows, and half of one is
less than a warped image costs."""

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
        model: What aligns the rows: "raw" (nothing to do), "rotation" or "homographies".
        H_left: float64 (3, 3), from raw to rectified pixels.
        H_right: The same for the right image.
        fundamental: float64 (3, 3), ``right.T @ F @ left = 0`` for raw pixels.
        features: The inlier matches, raw pixels.
        matches: Number of all matches.
        rows_px: float64 (N,), left minus right row of each of ``features``, rectified.
        before_px: Median absolute row error of all matches of all pairs, raw.
        after_px: The same, rectified.
        held_out_px: Mean absolute row error of matches held out of the fit; NaN = too few.
        disparity_px: 1st and 99th percentile of the rectified disparity.
    """

    model: str
    H_left: Float64
    H_right: Float64
    fundamental: Float64
    features: PairFeatures
    matches: int
    rows_px: Float64
    before_px: float
    after_px: float
    held_out_px: float
    disparity_px: tuple[float, float]


def rectify_images(
    pairs: Sequence[tuple[UInt8, UInt8]], count: int = MOST_FEATURES
) -> UncalibratedRectification:
    """Find the simplest change that aligns the rows of images of uncalibrated cameras.

    The images as they are, a small rotation of the right camera and homographies are compared by
    their row errors over held-out pairs (of a single pair: features). If homographies win, features
    are matched again in the images that these align.

    Args:
        pairs: uint8 (H, W) left and right, of one pair or of several pairs of one rig.
        count: Maximum number of features per image.

    Raises:
        CalibrationError: See `rectify_uncalibrated`; or no model aligns the rows.
    """
    height, width = pairs[0][0].shape
    size = (width, height)
    matched = [match_exactly(left, right, count) for left, right in pairs]
    # The initial guess may rest on few matches: the second round checks it.
    found = _choose(matched, size, _FEWEST_AT_FIRST)
    if found.model == "homographies":
        H = (found.H_left, found.H_right)
        matched = [match_again(left, right, *H, count) for left, right in pairs]
        found = _choose(matched, size, _MIN_FEATURES)
    return found


def _choose(
    matched: Sequence[PairFeatures], size: Size, min_features: int
) -> UncalibratedRectification:
    """Return the simplest model whose held-out row errors are not clearly above the smallest."""
    features = pool_features(matched)
    if len(features) < min_features:
        _fundamental(features, min_features)  # raises, and says of how many
    several = sum(len(each) > 0 for each in matched) >= _HELD_OUT
    pair = np.repeat(np.arange(len(matched)), [len(each) for each in matched])
    block = np.unique(pair, return_inverse=True)[1] if several else np.arange(len(features))
    held = block % 2 == 1 if several else block % _HELD_OUT == 0
    trials, _ = _candidates(features.select(~held), size, _FEWEST_AT_FIRST)
    errors = {
        name: _block_means(_row_errors(*H, features.select(held)), block[held])
        for name, H in trials.items()
    }
    fits, refusal = _candidates(features, size, min_features)
    before = _row_errors(*fits["raw"], features)
    best = min(errors.values(), key=lambda each: float(each.mean()), default=np.zeros(0))
    for name, H in fits.items():
        after = _row_errors(*H, features)
        agreeing = after < _INLIER_PX
        if name not in errors or _clearly_above(errors[name], best) or after.mean() > before.mean():
            continue
        # A model that is no homography has to hold for most matches, else there is no geometry.
        if name != "homographies" and agreeing.sum() < max(_MIN_FEATURES, len(features) / 2):
            continue
        F = np.asarray(H[1].T @ hat(np.array([1.0, 0.0, 0.0])) @ H[0])
        held_out_px = _held_out(trials[name], features.select(held))
        return _result(name, H, F, features.select(agreeing), features, held_out_px)
    raise refusal or CalibrationError(
        "rows cannot be aligned",
        got=f"{before.mean():.1f} px mean row error as recorded, and no smaller one",
        expected=f"at most {_MAX_ROW_PX:g} px",
        hint="use more pairs with texture, or a calibration: recon calibrate",
    )


def _candidates(
    features: PairFeatures, size: Size, min_features: int
) -> tuple[dict[str, tuple[Float64, Float64]], CalibrationError | None]:
    """Return left and right homographies by model, the simplest first; why the last is missing."""
    fits = {"raw": (np.eye(3), np.eye(3))}
    turns = [H for share in _FOCAL_WIDTHS if (H := _turned(features, size, share)) is not None]
    if turns:
        errors = [_row_errors(np.eye(3), H, features).mean() for H in turns]
        fits["rotation"] = (np.eye(3), turns[int(np.argmin(errors))])
    try:
        fits["homographies"] = _fit(features, size, min_features)[:2]
    except CalibrationError as refusal:
        return fits, refusal
    return fits, None


def _turned(features: PairFeatures, size: Size, focal_widths: float) -> Float64 | None:
    """Return the homography of the smallest rotation of the right camera that aligns rows."""
    centre = ((size[0] - 1) / 2, (size[1] - 1) / 2)
    focal = focal_widths * size[0]
    camera = RectifiedCamera(
        width_px=size[0], height_px=size[1], focal_px=focal, cx_px=centre[0], cy_px=centre[1],
        cx_right_px=centre[0], baseline_m=1.0,
    )  # fmt: skip
    found = align_rows(features.left_uv, features.right_uv, camera)
    if found is None:
        return None
    K = np.array([[focal, 0, centre[0]], [0, focal, centre[1]], [0, 0, 1.0]])
    H = K @ exp_so3(found.turn[:3]) @ np.linalg.inv(K)
    columns = features.left_uv[:, 0] - map_pixels(H, features.right_uv)[:, 0]
    # A matcher searches from 0: cameras that are turned towards each other are shifted apart.
    least = min(0.0, float(np.percentile(columns, 1)))
    return np.asarray(np.array([[1.0, 0, least], [0, 1, 0], [0, 0, 1]]) @ H)


def _row_errors(H_left: Float64, H_right: Float64, features: PairFeatures) -> Float64:
    """Return float64 (N,), absolute row errors of matches; those of false matches are limited."""
    left, right = map_pixels(H_left, features.left_uv), map_pixels(H_right, features.right_uv)
    return np.minimum(np.abs(left[:, 1] - right[:, 1]), 4 * _INLIER_PX)


def _block_means(errors: Float64, block: NDArray[np.intp]) -> Float64:
    """Return the mean error of each block: of a pair, or of a single feature."""
    return np.array([errors[block == each].mean() for each in np.unique(block)])


def _clearly_above(errors: Float64, best: Float64) -> bool:
    """Return whether errors exceed the best by two standard errors and what features resolve."""
    more = errors - best
    if not len(more):
        return False
    deviation = float(more.std(ddof=1)) if len(more) > 1 else 0.0
    return bool(more.mean() > max(2 * deviation / np.sqrt(len(more)), _RESOLVED_PX))


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
    return _result("homographies", (H_left, H_right), F, agreeing, features, held_out_px)


def _result(
    model: str,
    homographies: tuple[Float64, Float64],
    F: Float64,
    agreeing: PairFeatures,
    features: PairFeatures,
    held_out_px: float,
) -> UncalibratedRectification:
    """Return the result with its row errors; raises if these are too large."""
    left, right = (
        map_pixels(H, uv)
        for H, uv in zip(homographies, (agreeing.left_uv, agreeing.right_uv), strict=True)
    )
    rows = left[:, 1] - right[:, 1]
    if len(rows) == 0 or float(np.abs(rows).mean()) > _MAX_ROW_PX:
        raise CalibrationError(
            "rows cannot be aligned",
            got=f"{np.abs(rows).mean():.1f} px mean row error" if len(rows) else "no match aligned",
            expected=f"at most {_MAX_ROW_PX:g} px",
            hint="lenses with distortion need a calibration: recon calibrate",
        )
    low, high = np.percentile(left[:, 0] - right[:, 0], (1, 99))
    raw_rows = np.abs(features.left_uv[:, 1] - features.right_uv[:, 1])
    return UncalibratedRectification(
        model=model,
        H_left=homographies[0],
        H_right=homographies[1],
        fundamental=F,
        features=agreeing,
        matches=len(features),
        rows_px=rows,
        before_px=float(np.median(raw_rows)),
        after_px=float(np.median(_row_errors(*homographies, features))),
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
            got=f"{int(agreeing.sum())} of {counted(len(features), 'match', 'matches')}",
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
    rows = _row_errors(*homographies, features)
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
