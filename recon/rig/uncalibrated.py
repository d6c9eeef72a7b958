"""Rectification without a calibration: the simplest change that aligns rows; up to scale."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Final

import cv2
import numpy as np

from recon.core.errors import CalibrationError
from recon.core.geometry.alignment import Problem, minimise
from recon.core.geometry.se3 import exp_so3, hat
from recon.core.text import counted
from recon.core.values import RectifiedCamera
from recon.core.values.arrays import Bool, Float64, UInt8
from recon.stereo.rectify.epipolar import align_epipolar
from recon.stereo.rectify.features import (
    MOST_FEATURES,
    PairFeatures,
    map_pixels,
    match_again,
    match_exactly,
    pool_features,
)

Size = tuple[int, int]
Homographies = tuple[Float64, Float64]
_MOST_STRETCHED: Final = 20.0  # largest ratio of the scales at two corners of an image
_SMALLEST_DISPARITY_PX: Final = 4.0  # of the farthest matches; a matcher searches from 0
_FEWEST: Final = 8
# With little parallax, a wide threshold accepts a wrong geometry: several are tried.
_DRAWS: Final = (
    (cv2.USAC_MAGSAC, 1.0), (cv2.USAC_MAGSAC, 0.5), (cv2.USAC_MAGSAC, 0.25), (cv2.RANSAC, 1.0),
)  # fmt: skip
_ROUNDS: Final = 50
_STILL: Final = 1e-7  # relative decrease of the cost at which the fit ends
_STEP: Final = 1e-6
_SMALLEST_PX: Final = 0.1  # errors below about this size are weighted alike
_INLIER_PX: Final = 1.0  # largest distance of an inlier from its epipolar line
_FEWEST_AT_FIRST: Final = 12
_MIN_FEATURES: Final = 40  # matches that must agree on one geometry
_HELD_OUT: Final = 4  # every fourth feature of a single pair is held out of the fit
_FLAT_RATIO: Final = 0.9  # fraction of matches on one plane from which the scene counts as flat
_FOCAL_WIDTHS: Final = (0.5, 0.7, 1.0, 1.4, 2.0, 4.0)  # tried: they decide how pitch bends rows
_RESOLVED_PX: Final = (
    0.5  # epipolar error that a simpler model may have more: warped images cost more
)


@dataclass(frozen=True, eq=False)
class UncalibratedRectification:
    """Rectifying homographies, and how good they are, as ``summary.json`` has it."""

    model: str  # what aligns the rows: "raw" (nothing to do), "rotation" or "homographies"
    matches: int  # number of all matches
    inliers: int  # number of those that the homographies bring onto one row
    epipolar_error_before_px: float  # median of absolute errors of all matches of all pairs, raw
    epipolar_error_after_px: float  # the same, rectified
    epipolar_error_held_out_px: float  # mean of matches held out of the fit; NaN = too few
    disparity_range_px: tuple[float, float]  # 1st and 99th percentile of the rectified disparity
    H_left: Float64  # (3, 3), from raw to rectified pixels
    H_right: Float64  # the same for the right image

    @property
    def fundamental(self) -> Float64:
        """The fundamental matrix: float64 (3, 3), ``right.T @ F @ left = 0`` for raw pixels."""
        return np.asarray(self.H_right.T @ hat(np.array([1.0, 0.0, 0.0])) @ self.H_left)


def rectify_images(
    pairs: Sequence[tuple[UInt8, UInt8]], count: int = MOST_FEATURES
) -> UncalibratedRectification:
    """Find the simplest change that aligns the rows of grey pairs of one uncalibrated rig."""
    height, width = pairs[0][0].shape
    matched = [match_exactly(left, right, count) for left, right in pairs]
    # The initial guess may rest on few matches: homographies are refined by a second round.
    found = rectify_features(matched, (width, height), _FEWEST_AT_FIRST)
    if found.model != "homographies":
        return found
    H = (found.H_left, found.H_right)
    again = [match_again(left, right, *H, count) for left, right in pairs]
    return rectify_features(again, (width, height))


def rectify_features(
    matched: Sequence[PairFeatures], size: Size, min_features: int = _MIN_FEATURES
) -> UncalibratedRectification:
    """Find the simplest change whose held-out epipolar errors are not clearly above the smallest.

    Held out are every second pair or, of fewer than four, every fourth feature; ``min_features``
    must agree on homographies.
    """
    features = pool_features(matched)
    several = sum(len(each) > 0 for each in matched) >= _HELD_OUT
    pair = np.repeat(np.arange(len(matched)), [len(each) for each in matched])
    block = np.unique(pair, return_inverse=True)[1] if several else np.arange(len(features))
    held = block % 2 == 1 if several else block % _HELD_OUT == 0
    trials, _ = _candidates(features.select(~held), size, _FEWEST_AT_FIRST)
    held_out = {name: _epipolar_errors(H, features.select(held)) for name, H in trials.items()}
    counts = np.bincount(block[held])
    blocks = {
        name: np.bincount(block[held], errors)[counts > 0] / counts[counts > 0]
        for name, errors in held_out.items()
    }
    best = min(blocks.values(), key=lambda each: float(each.sum()))
    fits, refusal = _candidates(features, size, min_features)
    before = _epipolar_errors(fits["raw"], features)
    for name, H in fits.items():
        after = _epipolar_errors(H, features)
        if name not in blocks or after.sum() > before.sum():
            continue
        # Clearly above: by two standard errors, and by what features resolve.
        more = blocks[name] - best
        deviation = float(more.std(ddof=1)) if len(more) > 1 else 0.0
        resolved = max(2 * deviation / max(len(more), 1) ** 0.5, _RESOLVED_PX)
        if len(more) and more.mean() > resolved:
            continue
        # A model that is no homography has to hold for most matches, else there is no geometry.
        enough = 1 if name == "homographies" else max(_MIN_FEATURES, len(features) / 2)
        if (after < _INLIER_PX).sum() >= enough:
            return _result(name, H, features, held_out[name])
    raise refusal or CalibrationError(
        "rows cannot be aligned",
        got=f"{before.mean():.1f} px mean epipolar error as recorded, and no smaller one",
        hint="use more pairs with texture, or a calibration: recon calibrate",
    )


def _candidates(
    features: PairFeatures, size: Size, min_features: int
) -> tuple[dict[str, Homographies], CalibrationError | None]:
    """Return homographies by model, the simplest first; and why the last one is missing."""
    fits = {"raw": (np.eye(3), np.eye(3))}
    turns = [H for ratio in _FOCAL_WIDTHS if (H := _turned(features, size, ratio)) is not None]
    if turns:
        fits["rotation"] = min(turns, key=lambda H: float(_epipolar_errors(H, features).mean()))
    try:
        fits["homographies"] = _fit(features, size, min_features)
    except CalibrationError as refusal:
        return fits, refusal
    return fits, None


def _turned(features: PairFeatures, size: Size, focal_widths: float) -> Homographies | None:
    """Return the homographies of the smallest rotation of the right camera that aligns rows."""
    cx, cy, focal = (size[0] - 1) / 2, (size[1] - 1) / 2, focal_widths * size[0]
    camera = RectifiedCamera(focal, cx, cy, cx, 1.0, *size)
    found = align_epipolar(features.left_uv, features.right_uv, camera)
    if found is None:
        return None
    K = np.array([[focal, 0, cx], [0, focal, cy], [0, 0, 1.0]])
    H = K @ exp_so3(found.turn[:3]) @ np.linalg.inv(K)
    columns = features.left_uv[:, 0] - map_pixels(H, features.right_uv)[:, 0]
    # A matcher searches from 0: cameras that are turned towards each other are shifted apart.
    least = min(0.0, float(np.percentile(columns, 1)))
    return np.eye(3), np.array([[1.0, 0, least], [0, 1, 0], [0, 0, 1]]) @ H


def _fit(features: PairFeatures, size: Size, min_features: int) -> Homographies:
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
    flat_ratio = 0.0 if mask is None else float(np.mean(mask))
    if flat_ratio > _FLAT_RATIO:
        raise CalibrationError(
            "the scene is flat and does not determine the camera geometry",
            got=f"{100 * flat_ratio:.0f} % of the matches on one plane",
            expected=f"at most {100 * _FLAT_RATIO:g} %",
            hint="use a scene with both near and far objects, or calibrate: recon calibrate",
        )
    return rectifying_homographies(F, some, size)


def _epipolar_errors(H: Homographies, features: PairFeatures) -> Float64:
    """Return float64 (N,), absolute epipolar errors of matches, limited for false ones."""
    left, right = map_pixels(H[0], features.left_uv), map_pixels(H[1], features.right_uv)
    return np.minimum(np.abs(left[:, 1] - right[:, 1]), 4 * _INLIER_PX)


def _result(
    model: str, H: Homographies, features: PairFeatures, held_out: Float64
) -> UncalibratedRectification:
    errors = _epipolar_errors(H, features)
    agreeing, good = errors < _INLIER_PX, held_out < 4 * _INLIER_PX
    left, right = map_pixels(H[0], features.left_uv), map_pixels(H[1], features.right_uv)
    low, high = np.percentile((left - right)[agreeing, 0], (1, 99))
    return UncalibratedRectification(
        model=model,
        matches=len(features),
        inliers=int(agreeing.sum()),
        epipolar_error_before_px=float(
            np.median(np.abs(features.left_uv - features.right_uv)[:, 1])
        ),
        epipolar_error_after_px=float(np.median(errors)),
        epipolar_error_held_out_px=float(held_out[good].mean()) if good.any() else float("nan"),
        disparity_range_px=(float(low), float(high)),
        H_left=H[0],
        H_right=H[1],
    )


def rectifying_homographies(F: Float64, features: PairFeatures, size: Size) -> Homographies:
    """Return float64 (3, 3) for the left and for the right image, which align matching rows.

    Borders stay as near to their places as aligned rows allow; disparities are positive. The
    matches are correct ones, ``right.T @ F @ left = 0``.

    Ref: Hartley 1999, "Theory and practice of projective rectification", as OpenCV has it.
    """
    left_px, right_px = features.left_uv.astype(np.float64), features.right_uv.astype(np.float64)
    _, *found = cv2.stereoRectifyUncalibrated(left_px, right_px, F, size, threshold=0)
    x, y = np.meshgrid(np.linspace(0, size[0] - 1, 3), np.linspace(0, size[1] - 1, 3))
    border = np.delete(np.stack([x.ravel(), y.ravel()], axis=1), 4, axis=0)
    views = _levelled([np.asarray(H, np.float64) for H in found], border)
    moved = [map_pixels(H, border) for H in views]
    # Rows are scaled and shifted alike; columns of each image scaled, sheared and shifted.
    rows = _affine(np.concatenate(moved)[:, 1:], np.tile(border[:, 1], 2))
    left, right = (
        np.array([_affine(places, border[:, 0]), [0.0, *rows], [0.0, 0.0, 1.0]]) @ H
        for places, H in zip(moved, views, strict=True)
    )
    columns = map_pixels(left, left_px)[:, 0] - map_pixels(right, right_px)[:, 0]
    least = float(np.percentile(columns, 1)) - _SMALLEST_DISPARITY_PX
    return left, np.array([[1.0, 0.0, least], [0.0, 1.0, 0.0], [0.0, 0.0, 1.0]]) @ right


def _levelled(views: list[Float64], border: Float64) -> list[Float64]:
    """Tilt both images together about a horizontal axis, until top and bottom have equal scale."""
    points = np.hstack([border, np.ones((len(border), 1))])
    views = [H / (points @ H[2]).mean() for H in views]
    for side, H in zip(("left", "right"), views, strict=True):
        depth = points @ H[2]
        if not depth.min() > depth.max() / _MOST_STRETCHED:  # also where it is NaN
            raise CalibrationError(
                f"the {side} image sees the other camera: one is in front of the other",
                got="epipole in it, or close to its border",
                expected="outside the image",
                hint="put the cameras side by side",
            )
    y0 = float(np.mean([map_pixels(H, border.mean(axis=0)[None])[0, 1] for H in views]))
    rows, depth = (
        np.stack([points @ (H[k] - shift * H[2]) for H in views]) for k, shift in ((1, y0), (2, 0))
    )
    rows, depth = (each - each.mean(axis=1, keepdims=True) for each in (rows, depth))
    # Rows stay aligned under (x, y) -> (x, y) / (1 + g·(y - y0)); this makes the third coordinates
    # as even as possible along the borders of both images.
    g = -float((rows * depth).sum() / (rows * rows).sum())
    return [np.array([[1.0, 0.0, 0.0], [0.0, 1.0, 0.0], [0.0, g, 1.0 - g * y0]]) @ H for H in views]


def _affine(places: Float64, wanted: Float64) -> Float64:
    """Return the factors of the coordinates (N, k) and the shift that give (N,) numbers best."""
    found = np.linalg.lstsq(np.column_stack([places, np.ones(len(places))]), wanted, rcond=None)
    return np.asarray(found[0], dtype=np.float64)


def find_fundamental(features: PairFeatures, inlier_px: float) -> tuple[Float64 | None, Bool]:
    """Estimate the fundamental matrix robustly (RANSAC, MAGSAC++) and refine it on its inliers.

    Returns float64 (3, 3), or None; and bool (N,), matches at most ``inlier_px`` off their lines.
    """
    left, right = features.left_uv.astype(np.float64), features.right_uv.astype(np.float64)
    best, distances = None, np.full(len(left), np.inf)
    for method, ratio in _DRAWS if len(left) >= _FEWEST else ():
        try:
            F, _ = cv2.findFundamentalMat(left, right, method, ratio * inlier_px, 0.9999, 10000)
        except cv2.error:  # no model found
            continue
        if F is None or F.shape != (3, 3):
            continue
        for _ in range(2):  # fitted to the inliers, and to those of that fit
            agreeing = np.abs(line_distances(F, left, right)) <= inlier_px
            if agreeing.sum() >= _FEWEST:
                F = fit_fundamental(F, left[agreeing], right[agreeing])
        apart = np.abs(line_distances(F, left, right))
        if np.minimum(apart, inlier_px).sum() < np.minimum(distances, inlier_px).sum():
            best, distances = F, apart
    return best, np.asarray(distances <= inlier_px)


def fit_fundamental(F: Float64, left_px: Float64, right_px: Float64) -> Float64:
    """Refine a fundamental matrix, minimising the absolute distances of inliers (N, 2).

    Ref: Bartoli and Sturm 2004, "Non-linear estimation of the fundamental matrix".
    """
    middle = np.concatenate([left_px, right_px]).mean(axis=0)
    scale = 1.0 / max(float(np.abs([left_px - middle, right_px - middle]).mean()), 1e-12)
    N = np.array([[scale, 0, -scale * middle[0]], [0, scale, -scale * middle[1]], [0, 0, 1.0]])
    inverse = np.linalg.inv(N)
    U, S, Vt = np.linalg.svd(inverse.T @ F @ inverse)

    def moved(step: Float64) -> Float64:
        angle = np.arctan2(S[1], S[0]) + step[6]
        middle = np.diag([np.cos(angle), np.sin(angle), 0.0])
        return np.asarray(N.T @ U @ exp_so3(step[:3]) @ middle @ exp_so3(step[3:6]) @ Vt @ N)

    def apart(step: Float64) -> Float64:
        return line_distances(moved(step), left_px, right_px)

    def linearise(step: Float64) -> tuple[Float64, Float64]:
        error = apart(step)
        J = np.stack([(apart(step + _STEP * e) - error) / _STEP for e in np.eye(7)], axis=1)
        weighted = J / np.hypot(error, small_px)[:, None]
        return weighted.T @ J, weighted.T @ error

    def solve(step: Float64, normal: tuple[Float64, Float64], damping: float) -> Float64:
        A, a = normal
        return step - np.linalg.lstsq(A + damping * np.diag(np.diag(A)), a, rcond=1e-12)[0]

    small_px = _SMALLEST_PX + float(np.median(np.abs(apart(np.zeros(7)))))
    cost = Problem(lambda step: float(np.hypot(apart(step), small_px).sum()), linearise, solve)
    return moved(minimise(cost, np.zeros(7), rounds=_ROUNDS, min_gain=_STILL))


def line_distances(F: Float64, left_px: Float64, right_px: Float64) -> Float64:
    """Return float64 (N,), signed Sampson distances: the error of each match to first order.

    Ref: Hartley and Zisserman 2004, equation 11.9.
    """
    ones = np.ones((len(left_px), 1))
    left, right = np.hstack([left_px, ones]), np.hstack([right_px, ones])
    in_right, in_left = left @ F.T, right @ F
    size = np.linalg.norm(np.hstack([in_right[:, :2], in_left[:, :2]]), axis=1)
    return np.asarray((right * in_right).sum(axis=1) / np.maximum(size, 1e-300))
