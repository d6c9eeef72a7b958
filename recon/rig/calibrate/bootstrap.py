"""Uncertainty of a calibration, by bootstrap over its views.

A resample is one Newton step from the solution, with each view weighted by how often it was drawn.
The step reuses the solver's normal equations, so hundreds take a fraction of a second.
"""

from __future__ import annotations

from contextlib import suppress
from dataclasses import dataclass
from typing import Final

import numpy as np

from recon.core.errors import CalibrationError
from recon.core.geometry.se3 import apply, invert
from recon.core.progress import tracked
from recon.core.text import counted
from recon.core.values import StereoCalibration
from recon.core.values.arrays import Float64
from recon.rig.calibrate.bundle import moved, solve_scaled
from recon.rig.calibrate.stereo import StereoFit, stereo_of
from recon.rig.settings import CalibrationSettings
from recon.stereo.rectify.lens import project_into_image, rays_of

_PLACES: Final = (0.2, 0.5, 0.8)  # depth errors are those of a 3 by 3 grid in the left image
_MIDDLE: Final = 4
_MATCHED: Final = 0.02  # relative error of matching at the default working distance
MATCH_SIGMA_PX: Final = 0.25  # assumed matching error, by which depth errors are predicted
DEPTHS_M: Final = (2.0, 5.0, 10.0, 20.0)  # depths at which the error is predicted
_RESAMPLES: Final = 500
CONFIDENCE: Final = 0.95  # confidence level of the intervals


@dataclass(frozen=True)
class DepthError:
    """Predicted depth error at one distance along the optical axis of the left camera."""

    depth_m: float  # the distance
    calibration_m: float  # rms error over resamples and image; NaN = the views do not overlap
    low_m: float  # interval of the error at the image centre; negative = measured too near
    high_m: float
    matching_m: float  # error due to matching, with `MATCH_SIGMA_PX`


@dataclass(frozen=True, eq=False)
class Spread:
    """Bootstrap intervals (low, high) of the calibration."""

    focal_px: tuple[float, float]  # of the left focal length
    baseline_m: tuple[float, float]  # of the baseline
    rotation_deg: float  # root mean square rotation of the right camera relative to the solution
    depths: tuple[DepthError, ...]  # predicted depth error at each distance
    working: DepthError  # the same at the working distance, see `_working_distance`


def _resample(fit: StereoFit) -> list[StereoCalibration]:
    """Return rigs calibrated from bootstrap resamples of the views; failed ones are left out."""
    rng = np.random.default_rng(0)
    count, info = len(fit.views), fit.information
    vectors = _jackknife_vectors(fit)
    rigs = []
    for _ in tracked(range(_RESAMPLES), "samples"):
        drawn = rng.multinomial(count, np.full(count, 1 / count)).astype(np.float64)
        A = info.prior + np.tensordot(drawn, info.matrices, axes=1)
        # At the solution the vectors sum to zero, up to the prior of rational lenses.
        step = solve_scaled(A, (drawn - 1.0) @ vectors)
        with suppress(CalibrationError):  # it does not determine a rig
            rigs.append(stereo_of(moved(fit.state, step)))
    if len(rigs) < _RESAMPLES / 2:
        raise CalibrationError(
            "views do not determine the rig",
            got=counted(count, "view"),
            hint="take more, with the board tilted, near and far, and in every image corner",
        )
    return rigs


def measure_spread(fit: StereoFit, settings: CalibrationSettings) -> Spread:
    """Return bootstrap intervals of focal length, baseline, rotation and depth."""
    rigs = _resample(fit)
    turns = [rig.T_right_left[:3, :3] @ fit.calibration.T_right_left[:3, :3].T for rig in rigs]
    cosines = np.clip((np.trace(turns, axis1=1, axis2=2) - 1) / 2, -1, 1)
    return Spread(
        focal_px=_interval([rig.left.matrix[0, 0] for rig in rigs]),
        baseline_m=_interval([rig.baseline_m for rig in rigs]),
        rotation_deg=float(np.degrees(np.sqrt(np.mean(np.arccos(cosines) ** 2)))),
        depths=tuple(_depth_error(fit, rigs, depth) for depth in DEPTHS_M),
        working=_depth_error(fit, rigs, _working_distance(fit.calibration, settings)),
    )


def _working_distance(rig: StereoCalibration, settings: CalibrationSettings) -> float:
    """Return the distance at which depth matters: by default, where matching errs by 2 %.

    Errors of calibration grow with its square as well: it is the same to ask there whether the
    calibration is as good as the matching.
    """
    usual_m = _MATCHED * float(rig.left.matrix[0, 0]) * rig.baseline_m / MATCH_SIGMA_PX
    return usual_m if settings.working_m is None else settings.working_m


def measure_depth(rig: StereoCalibration, left_px: Float64, right_px: Float64) -> Float64:
    """Return float64 (N,), depth along the left optical axis, from matched raw pixels."""
    T_left_right = invert(rig.T_right_left)
    a = rays_of(rig.left, left_px)
    b = rays_of(rig.right, right_px) @ T_left_right[:3, :3].T
    # Closest points of the lines l·a and c + m·b, from their normal equations.
    c = T_left_right[:3, 3]
    aa, ab, bb = (np.einsum("ni,ni->n", p, q) for p, q in ((a, a), (a, b), (b, b)))
    with np.errstate(divide="ignore", invalid="ignore"):
        return np.asarray((bb * (a @ c) - ab * (b @ c)) / (aa * bb - ab**2))


def _jackknife_vectors(fit: StereoFit) -> Float64:
    """Return float64 (V, P), each view's gradient, corrected for its own effect on the solution.

    Ref: Bell and McCaffrey 2002, "Bias reduction in standard errors" (their jackknife form).
    """
    info = fit.information
    whole = info.prior + info.matrices.sum(axis=0)
    # (1 - M / W)^-1 v = W (W - M)^-1 v: well conditioned although the parameters differ in size.
    each = zip(info.matrices, info.vectors, strict=True)
    return np.array([whole @ solve_scaled(whole - matrix, vector) for matrix, vector in each])


def _interval(values: list[float]) -> tuple[float, float]:
    aside = (1 - CONFIDENCE) / 2
    low, high = np.nanquantile(values, (aside, 1 - aside))
    return float(low), float(high)


def _depth_error(fit: StereoFit, rigs: list[StereoCalibration], depth_m: float) -> DepthError:
    rig = fit.calibration
    width, height = rig.left.width_px, rig.left.height_px
    places = np.array([[x * width, y * height] for y in _PLACES for x in _PLACES])
    xyz = rays_of(rig.left, places) * depth_m
    right_px = project_into_image(rig.right, apply(rig.T_right_left, xyz))
    shared = np.asarray(np.isfinite(right_px).all(axis=1))
    focal_px = float(rig.left.matrix[0, 0])
    matching_m = depth_m**2 * MATCH_SIGMA_PX / (focal_px * rig.baseline_m)
    if not shared[_MIDDLE]:
        return DepthError(depth_m, np.nan, np.nan, np.nan, matching_m)
    seen = places[shared], right_px[shared]
    errors = np.array([measure_depth(other, *seen) - depth_m for other in rigs])
    middle = errors[:, int(shared[:_MIDDLE].sum())]
    low_m, high_m = _interval(list(middle))
    # NaN: the lens of a resample may not be invertible at the image border.
    rms_m = float(np.sqrt(np.nanmean(errors**2)))
    return DepthError(depth_m, rms_m, low_m, high_m, matching_m)
