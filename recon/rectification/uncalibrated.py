"""Rectify pairs of unknown cameras by two homographies: rows correspond, scale is unknown."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Final

import cv2
import numpy as np
from pydantic import Field

from recon.errors import CalibrationError
from recon.rectification.inspect import PairFeatures
from recon.rectification.shaping import map_pixels, shape_views
from recon.settings import Settings
from recon.structures.arrays import Bool, Float64

Size = tuple[int, int]

_ROUNDS: Final = 60
_STEP: Final = 1e-6
_HELD_OUT: Final = 4  # every fourth feature measures, the others fit


class UncalibratedSettings(Settings):
    """How pairs without calibration are rectified."""

    features: int = Field(default=8000, ge=100, description="Features per picture at most.")
    min_features: int = Field(
        default=40, ge=16, description="Fewer matches that agree on one geometry are refused."
    )
    inlier_px: float = Field(
        default=1.0, gt=0, description="Distance from its epipolar line up to which a match counts."
    )
    flat_share: float = Field(
        default=0.9,
        gt=0,
        le=1,
        description="Share of matches on one plane from which the scene counts as flat.",
    )
    max_row_px: float = Field(
        default=2.0, gt=0, description="A mean row error above this is refused, pixels."
    )
    pairs: int = Field(default=8, ge=1, description="Pairs of a folder that are looked at.")


@dataclass(frozen=True, eq=False)
class UncalibratedRectification:
    """Two homographies, and how good they are.

    Attributes:
        H_left: float64 (3, 3), from raw pixels to rectified ones.
        H_right: The same of the right picture.
        fundamental: float64 (3, 3), ``right.T @ F @ left = 0`` of raw pixels.
        features: The matches that agree, raw pixels.
        matches: Number of all matches.
        rows_px: float64 (N,), left less right row of each of `features`, rectified.
        held_out_px: Mean absolute row error of matches that took no part in the fit; NaN = none.
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


def rectify_uncalibrated(
    features: PairFeatures, size: Size, settings: UncalibratedSettings | None = None
) -> UncalibratedRectification:
    """Find homographies that bring matches of unknown cameras onto common rows.

    The fundamental matrix is found robustly (MAGSAC++), turned into homographies (Hartley), and
    these are fitted to the matches: seven numbers, by least absolute rows. What rows leave open
    is chosen so that the pictures are slanted little and disparities are positive.

    Args:
        features: Matches of one pair, or of several pairs of one rig.
        size: (width, height) of the pictures.
        settings: How.

    Raises:
        CalibrationError: Too few matches agree, or the scene is flat, or one camera stands in the
            view of the other.

    Ref: Hartley 1999, "Theory and practice of projective rectification"; OpenCV's
        ``stereoRectifyUncalibrated``.
    """
    settings = settings or UncalibratedSettings()
    used = np.arange(len(features)) % _HELD_OUT != 0
    held_out_px = float("nan")
    if used.sum() >= 2 * settings.min_features:
        trial = _fit(_some(features, used), size, settings)
        held_out_px = _held_out(trial[:2], _some(features, ~used), settings)
    H_left, H_right, F, agreeing = _fit(features, size, settings)
    left, right = (
        map_pixels(H, uv) for H, uv in ((H_left, agreeing.left_uv), (H_right, agreeing.right_uv))
    )
    rows = left[:, 1] - right[:, 1]
    if float(np.abs(rows).mean()) > settings.max_row_px:
        raise CalibrationError(
            "rows cannot be brought to correspond",
            got=f"{np.abs(rows).mean():.1f} px mean row error",
            expected=f"at most {settings.max_row_px:g} px",
            hint="lenses that bend straight lines need a calibration: recon calibrate",
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


def _some(features: PairFeatures, which: Bool) -> PairFeatures:
    return PairFeatures(features.left_uv[which], features.right_uv[which])


def _fit(
    features: PairFeatures, size: Size, settings: UncalibratedSettings
) -> tuple[Float64, Float64, Float64, PairFeatures]:
    """Homographies, the fundamental matrix, and the matches that agree with it."""
    F, agreeing = _fundamental(features, settings)
    _check_depth(agreeing, settings)
    _check_epipoles(F, size)
    done, H_left, H_right = cv2.stereoRectifyUncalibrated(
        agreeing.left_uv.astype(np.float64), agreeing.right_uv.astype(np.float64), F, size
    )
    if not done or not (np.isfinite(H_left).all() and np.isfinite(H_right).all()):
        raise CalibrationError("no homographies bring the rows together")
    # Rows are fitted in pixels of pictures that look as they will.
    H_left, H_right = shape_views(H_left, H_right, agreeing, size)
    H_left, H_right = _refine(H_left / H_left[2, 2], H_right / H_right[2, 2], agreeing, size)
    return *shape_views(H_left, H_right, agreeing, size), F, agreeing


def _fundamental(
    features: PairFeatures, settings: UncalibratedSettings
) -> tuple[Float64, PairFeatures]:
    F, mask = None, np.zeros(0, bool)
    if len(features) >= settings.min_features:
        F, inliers = cv2.findFundamentalMat(
            features.left_uv,
            features.right_uv,
            cv2.USAC_MAGSAC,
            settings.inlier_px,
            0.9999,
            10000,
        )
        mask = np.zeros(0, bool) if inliers is None else np.asarray(inliers).ravel() > 0
    if F is None or F.shape != (3, 3) or mask.sum() < settings.min_features:
        raise CalibrationError(
            "too few features of both pictures agree on one geometry",
            got=f"{int(mask.sum())} of {len(features)} matches",
            expected=f"at least {settings.min_features}",
            hint="are these two views of one scene, with texture?",
        )
    return np.asarray(F, dtype=np.float64), _some(features, mask)


def _check_epipoles(F: Float64, size: Size) -> None:
    """A homography tears a picture apart that sees the other camera."""
    U, _, Vt = np.linalg.svd(F)
    for side, epipole in (("left", Vt[2]), ("right", U[:, 2])):
        with np.errstate(divide="ignore", invalid="ignore"):
            x, y = epipole[:2] / epipole[2]
        if 0 <= x < size[0] and 0 <= y < size[1]:
            raise CalibrationError(
                f"the {side} picture sees the other camera: one stands before the other",
                got=f"epipole at ({x:.0f}, {y:.0f}) px",
                expected="outside the picture",
                hint="put the cameras side by side",
            )


def _refine(
    H_left: Float64, H_right: Float64, features: PairFeatures, size: Size
) -> tuple[Float64, Float64]:
    """Fit rows to the matches by the seven numbers that a fundamental matrix has.

    Five are rows 2 and 3 of the left homography, two the direction of row 3 of the right one.
    """
    # Row 3 is in 1/px: scaled so that a unit of each number moves a border by about a pixel.
    unit = np.array([1 / size[0], 1 / size[1], 1, 1 / size[0] ** 2, 1 / size[1] ** 2] * 2)[:7]
    unit[5:] = [1 / size[0] ** 2, 1 / size[1] ** 2]

    def rows(step: Float64) -> Float64:
        left, right = _moved(H_left, H_right, step * unit)
        a, b = map_pixels(left, features.left_uv), map_pixels(right, features.right_uv)
        return np.asarray(a[:, 1] - b[:, 1])

    step, damping = np.zeros(7), 1e-3
    apart = rows(step)
    for _ in range(_ROUNDS):
        weights = 1.0 / np.maximum(np.abs(apart), 0.1 + np.median(np.abs(apart)))
        J = np.stack([(rows(step + _STEP * e) - apart) / _STEP for e in np.eye(7)], axis=1)
        A = J.T @ (J * weights[:, None])
        move = np.linalg.lstsq(
            A + damping * np.diag(np.diag(A)), -J.T @ (weights * apart), rcond=1e-12
        )[0]
        trial = rows(step + move)
        if np.isfinite(trial).all() and weights @ trial**2 < weights @ apart**2:
            gain = 1 - (weights @ trial**2) / (weights @ apart**2)
            step, apart, damping = step + move, trial, damping / 5
            if gain < 1e-8:
                break
        else:
            damping *= 10
    return _moved(H_left, H_right, step * unit)


def _moved(H_left: Float64, H_right: Float64, step: Float64) -> tuple[Float64, Float64]:
    left, right = H_left.copy(), H_right.copy()
    left[1] += step[:3]
    left[2, :2] += step[3:5]
    right[2, :2] += step[5:]
    return left, right


def _held_out(
    homographies: tuple[Float64, Float64], features: PairFeatures, settings: UncalibratedSettings
) -> float:
    """Mean absolute row error of matches of which the wrong ones are left out."""
    H_left, H_right = homographies
    left, right = map_pixels(H_left, features.left_uv), map_pixels(H_right, features.right_uv)
    rows = np.abs(left[:, 1] - right[:, 1])
    good = rows < 4 * settings.inlier_px
    return float(rows[good].mean()) if good.any() else float("nan")


def _check_depth(features: PairFeatures, settings: UncalibratedSettings) -> None:
    """Two views of a plane go with any pair of cameras: rows of another scene would not fit."""
    _, mask = cv2.findHomography(
        features.left_uv, features.right_uv, cv2.USAC_MAGSAC, settings.inlier_px
    )
    share = 0.0 if mask is None else float(np.mean(mask))
    if share > settings.flat_share:
        raise CalibrationError(
            "the scene is flat: it does not tell how the cameras stand",
            got=f"{100 * share:.0f} % of the matches on one plane",
            expected=f"at most {100 * settings.flat_share:g} %",
            hint="show near and far things together, or calibrate: recon calibrate",
        )
