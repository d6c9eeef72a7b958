"""Stereo calibration from views of a board, and how sure it is.

Views that do not fit are dropped and named. How sure a fit is shows a bootstrap over its views: a
resample is one Newton step from the solution, with each view weighted by how often it was drawn.
"""

from __future__ import annotations

import math
from collections.abc import Collection, Sequence
from contextlib import suppress
from dataclasses import dataclass, replace
from typing import Final

import cv2
import numpy as np
from numpy.typing import NDArray

from recon.core.errors import CalibrationError
from recon.core.geometry.se3 import apply, exp_so3, invert, log_so3, make_transform
from recon.core.progress import tracked
from recon.core.text import counted, round_lengths
from recon.core.values import CameraIntrinsics, StereoCalibration
from recon.core.values.arrays import Bool, Float64
from recon.rig.calibrate.bundle import (
    Information,
    RigState,
    Sighting,
    View,
    moved,
    solve,
    solve_scaled,
    squared_errors,
)
from recon.rig.settings import CalibrationSettings
from recon.stereo.rectify.lens import project_into_image, project_raw, rays_of

Size = tuple[int, int]
# Half fields of view that are tried for a fisheye lens.
_HALF_ANGLES: Final = tuple(math.radians(angle) for angle in (35, 45, 55, 65, 75, 85, 95, 110))
_COEFFICIENTS: Final = {"rational": 8}
_REWEIGHTED: Final = 4  # rounds of reweighting; outlying views stand out after two
_DROPPING_ROUNDS: Final = 4
_MISMATCH: Final = 3.0  # rms error relative to each camera alone if images do not belong together
# Views whose error exceeds this multiple of the median of all views are dropped …
_OUTLIER_RATIO: Final = 3.0
_OUTLIER_PX: Final = 0.3  # … but never those with an rms error below this
_MAX_RMS_PX: Final = 2.0  # largest rms error of an accepted calibration
_MIN_VIEWS: Final = 5  # minimum number of views with the board
# A view repeats another if the corners moved by less than this fraction of the board's size (rms,
# in the image): by what a hand moves that holds it still, 8 mm on 9 by 6 squares of 25 mm.
_STILL: Final = 0.1


@dataclass(frozen=True, eq=False)
class StereoFit:
    """A calibrated rig, and how well it fits."""

    calibration: StereoCalibration
    state: RigState  # the rig with the poses of the board
    information: Information
    views: tuple[View, ...]  # that were used
    repeated: tuple[str, ...]  # names of the views that were left out since they repeat another
    dropped: dict[str, float]  # rms errors of the views that were dropped, by name, in pixels
    errors_px: Float64  # (V, 2), rms error of each used view in the left and right image
    alone_px: tuple[float, float]  # rms error of each camera, calibrated alone
    rms_px: float  # rms reprojection error over all corners of both cameras


def calibrate_stereo(
    views: Sequence[View], size: Size, settings: CalibrationSettings, circle_m: float = 0.0
) -> StereoFit:
    """Calibrate two cameras: each alone, then all parameters of both together.

    ``circle_m`` is the diameter of circles whose centroids are given; 0 = the views are corners.

    Ref: Zhang 2000; the lens models are OpenCV's.
    """
    groups = _group_views(views)
    kept = [group[0] for group in groups]
    repeated = tuple(view.name for group in groups for view in group[1:])
    _check_count(kept, {}, repeated)
    left, right = (
        _calibrate_one([view.seen[side] for view in kept], size, settings) for side in (0, 1)
    )
    alone = tuple(
        _view_errors([replace(v, seen=(v.seen[side],)) for v in kept], state)
        for side, state in enumerate((left, right))
    )
    state = _solve_robustly(kept, _join_cameras(left, right))
    dropped: dict[str, float] = {}
    for _ in range(_DROPPING_ROUNDS):
        errors = _view_errors(kept, state)
        limit = max(_OUTLIER_RATIO * float(np.median(errors)), _OUTLIER_PX)
        good = errors <= limit
        dropped |= {v.name: float(e) for v, e, g in zip(kept, errors, good, strict=True) if not g}
        kept = [view for view, keep in zip(kept, good, strict=True) if keep]
        state = replace(state, T_rig_board=state.T_rig_board[good])
        alone = tuple(each[good] for each in alone)
        _check_count(kept, dropped, repeated)
        state, information = solve(kept, state)
        if good.all():
            break
    sums, counts = squared_errors(kept, state)
    rms_px = math.sqrt(float(sums.sum() / counts.sum()))
    left_px, right_px = (math.sqrt(float((errors**2).mean())) for errors in alone)
    _check_fit(rms_px, (left_px, right_px))
    if circle_m:
        fit = calibrate_stereo(_centred(kept, state, circle_m), size, settings)
        return replace(fit, repeated=repeated, dropped=dropped | fit.dropped)
    return StereoFit(
        calibration=stereo_of(state),
        state=state,
        information=information,
        views=tuple(kept),
        repeated=repeated,
        dropped=dropped,
        errors_px=np.sqrt(sums / counts),
        alone_px=(left_px, right_px),
        rms_px=rms_px,
    )


def _centred(views: Sequence[View], state: RigState, circle_m: float) -> list[View]:
    """Return views with the images of the centres of circles, which are not their centroids."""
    turn = np.linspace(0.0, 2 * math.pi, 32, endpoint=False)
    ring = circle_m / 2 * np.stack([np.cos(turn), np.sin(turn), 0 * turn], axis=1)

    def shifted(seen: Sighting, camera: CameraIntrinsics, T_camera_board: Float64) -> Sighting:
        around = apply(T_camera_board, (seen.board_m[:, None] + ring).reshape(-1, 3))
        u, v = project_raw(camera, around).reshape(-1, len(ring), 2).transpose(2, 0, 1)
        nu, nv = (np.roll(each, -1, axis=1) for each in (u, v))
        area = u * nv - nu * v  # twice that of each triangle with the origin
        centroid = np.stack([((u + nu) * area).sum(axis=1), ((v + nv) * area).sum(axis=1)], axis=1)
        middle = project_raw(camera, apply(T_camera_board, seen.board_m))
        moved_px = middle - centroid / (3 * area.sum(axis=1)[:, None])
        return replace(seen, pixels=seen.pixels + moved_px)

    return [
        replace(view, seen=tuple(map(shifted, view.seen, state.cameras, T @ T_rig_board)))
        for T in [np.stack(state.T_camera_rig)]
        for view, T_rig_board in zip(views, state.T_rig_board, strict=True)
    ]


def stereo_of(state: RigState) -> StereoCalibration:
    """Return the rig of a state."""
    left, right = state.cameras
    return StereoCalibration(left, right, state.T_camera_rig[1])


def _group_views(views: Sequence[View]) -> list[list[View]]:
    """Group the views by pose of the board, the view that represents a group first."""
    # Errors on a still board are mostly the same in every image: repeats measure nothing new.
    groups: list[list[View]] = []
    for view in views:
        same = next((group for group in groups if _moved(group[0], view) < _STILL), None)
        if same is None:
            groups.append(same := [])
        same.append(view)
    ordered = []
    for group in groups:
        # First the view that is nearest to a few of the others.
        some = group[:: max(1, len(group) // 8)]
        apart = [max(_moved(view, other) for other in some) for view in group]
        middle = int(np.argmin(apart)) if len(group) > 2 else 0
        ordered.append([group[middle], *group[:middle], *group[middle + 1 :]])
    return ordered


def _moved(first: View, second: View) -> float:
    return max(map(_shift, first.seen, second.seen))


def _shift(first: Sighting, second: Sighting) -> float:
    a, b = first.pixels, second.pixels
    if not np.array_equal(first.numbers, second.numbers):  # a board that is seen in part
        _, here, there = np.intersect1d(first.numbers, second.numbers, return_indices=True)
        if 2 * len(here) < max(len(a), len(b)):
            return np.inf
        a, b = a[here], b[there]
    # A chessboard turned by 180 degrees looks the same, and its corners may begin at either end.
    return min(_length_rms(a - b), _length_rms(a - b[::-1])) / _length_rms(a - a.mean(axis=0))


def _check_count(
    views: Sequence[View], dropped: Collection[str], repeated: tuple[str, ...]
) -> None:
    if len(views) >= _MIN_VIEWS:
        return
    lost = f", after {', '.join(dropped)} did not fit" if dropped else ""
    lost += f", and {len(repeated)} that repeat them" if repeated else ""
    raise CalibrationError(
        "too few views show the board in both images",
        got=f"{len(views)}{lost}",
        expected=f"at least {_MIN_VIEWS}",
        hint="take more, with the board tilted, and near and far",
    )


def _check_fit(rms_px: float, alone_px: tuple[float, float]) -> None:
    if rms_px <= _MAX_RMS_PX:
        return
    what = "no lens of this model fits the corners"
    hint = "is the board flat, and does --model (radtan, rational, fisheye) suit the lens?"
    if rms_px > _MISMATCH * max(alone_px):
        what = "each camera fits alone, but not both together"
        hint = "were left and right taken at the same time, and do their names pair them correctly?"
    raise CalibrationError(
        what,
        got=f"{rms_px:.1f} px rms (alone: left {alone_px[0]:.1f}, right {alone_px[1]:.1f})",
        expected=f"at most {_MAX_RMS_PX:g} px",
        hint=hint,
    )


def _length_rms(apart: Float64) -> float:
    return math.sqrt(float((apart**2).sum(axis=1).mean()))


def _calibrate_one(
    sightings: Sequence[Sighting], size: Size, settings: CalibrationSettings
) -> RigState:
    """Return the lens and board poses of one camera, with views that do not fit down-weighted."""
    views = [View(str(number), (seen,)) for number, seen in enumerate(sightings)]
    if settings.model == "fisheye":
        state = _guess_fisheye(sightings, size)
    else:
        camera = _guess_pinhole(sightings, size)
        distortion = np.zeros(_COEFFICIENTS.get(settings.model, 2 + settings.radial_terms))
        distortion[:2] = camera.distortion[:2]
        state = _with_poses(replace(camera, distortion=distortion), sightings)
    return _solve_robustly(views, state)


def _guess_pinhole(sightings: Sequence[Sighting], size: Size) -> CameraIntrinsics:
    """Return OpenCV's calibration: Zhang's closed form, refined with two radial terms."""
    boards = [seen.board_m.astype(np.float32) for seen in sightings]
    pixels = [seen.pixels.astype(np.float32) for seen in sightings]
    flags = cv2.CALIB_FIX_K3 | cv2.CALIB_ZERO_TANGENT_DIST
    try:
        found = cv2.calibrateCamera(boards, pixels, size, None, None, flags=flags)
    except cv2.error as error:
        raise CalibrationError("views do not determine a camera", got=error.err) from error
    return CameraIntrinsics(found[1], np.array(found[2], dtype=np.float64).ravel(), *size)


def _guess_fisheye(sightings: Sequence[Sighting], size: Size) -> RigState:
    """Return the undistorted fisheye lens, of several fields of view, that fits the board best."""
    radius, (cx, cy) = math.hypot(*size) / 2, ((n - 1) / 2 for n in size)
    views = [View("", (seen,)) for seen in sightings]
    best, least = None, math.inf
    for angle in _HALF_ANGLES:
        matrix = np.array([[radius / angle, 0, cx], [0, radius / angle, cy], [0, 0, 1]])
        camera = CameraIntrinsics(matrix, np.zeros(4), *size, "fisheye")
        with suppress(CalibrationError):
            state = _with_poses(camera, sightings)
            error = float(np.median(_view_errors(views, state)))
            if error < least:  # never where it is NaN
                best, least = state, error
    if best is None:
        raise CalibrationError("views do not determine a fisheye lens")
    return best


def _with_poses(camera: CameraIntrinsics, sightings: Sequence[Sighting]) -> RigState:
    poses = []
    for seen in sightings:
        rays = rays_of(camera, seen.pixels)
        known = np.isfinite(rays).all(axis=1)
        try:
            done, rotation, shift = cv2.solvePnP(
                seen.board_m[known], rays[known, :2], np.eye(3), None, flags=cv2.SOLVEPNP_IPPE
            )
        except cv2.error as error:
            raise CalibrationError("no pose of the board fits", got=error.err) from error
        if not done or not np.isfinite(shift).all():
            raise CalibrationError("no pose of the board fits")
        poses.append(make_transform(cv2.Rodrigues(rotation)[0], shift.ravel()))
    return RigState((camera,), (np.eye(4),), np.stack(poses))


def _join_cameras(left: RigState, right: RigState) -> RigState:
    """Return both cameras in one rig, with the median pose of the right camera over all views."""
    boards = zip(left.T_rig_board, right.T_rig_board, strict=True)
    T_right_left = [T_right @ invert(T_left) for T_left, T_right in boards]
    rotation = np.median([log_so3(T[:3, :3]) for T in T_right_left], axis=0)
    shift = np.median([T[:3, 3] for T in T_right_left], axis=0)
    T = make_transform(exp_so3(rotation), shift)
    return RigState((*left.cameras, *right.cameras), (np.eye(4), T), left.T_rig_board)


def _solve_robustly(views: Sequence[View], start: RigState) -> RigState:
    """Solve with each view weighted by how well it fits (Cauchy weights of its rms error)."""
    state, weights = start, np.ones(len(views))
    for _ in range(_REWEIGHTED):
        state, _ = solve(views, state, weights)
        errors = _view_errors(views, state)
        scale = 2.0 * float(np.median(errors)) + 1e-6
        weights = 1.0 / (1.0 + (errors / scale) ** 2)
    return state


def _view_errors(views: Sequence[View], state: RigState) -> Float64:
    sums, counts = squared_errors(views, state)
    return np.asarray(np.sqrt(sums.sum(axis=1) / counts.sum(axis=1)))


CELLS: Final = (8, 6)  # image cells; without corners in one, the lens is extrapolated there
_MATCHED: Final = 0.02  # relative error of matching at the default working distance
MATCH_SIGMA_PX: Final = 0.25  # assumed matching error, by which depth errors are predicted
_AROUND: Final = (0.2, 2.0)  # of the working distance: depths at which the error is predicted
_RESAMPLES: Final = 500
_ONE_SIGMA: Final = 0.6827  # of a normal distribution
CONFIDENCE: Final = 0.95  # confidence level of the intervals


@dataclass(frozen=True)
class DepthError:
    """Predicted depth error at one distance along the optical axis of the left camera."""

    depth_m: float  # the distance
    # standard error where corners were seen, rms over the image; NaN = the views do not overlap
    calibration_m: float
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
    # (V, P): the gradient of each view, corrected for its own effect on the solution, as
    # (1 - M / W)^-1 v = W (W - M)^-1 v: well conditioned although the parameters differ in size.
    # Ref: Bell and McCaffrey 2002, "Bias reduction in standard errors" (their jackknife form).
    whole = info.prior + info.matrices.sum(axis=0)
    each = zip(info.matrices, info.vectors, strict=True)
    vectors = np.array([whole @ solve_scaled(whole - matrix, vector) for matrix, vector in each])
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
    rigs, working_m = _resample(fit), _working_distance(fit.calibration, settings)
    turns = [rig.T_right_left[:3, :3] @ fit.calibration.T_right_left[:3, :3].T for rig in rigs]
    cosines = np.clip((np.trace(turns, axis1=1, axis2=2) - 1) / 2, -1, 1)
    depths_m = round_lengths(*(part * working_m for part in _AROUND))
    return Spread(
        focal_px=_interval([rig.left.matrix[0, 0] for rig in rigs]),
        baseline_m=_interval([rig.baseline_m for rig in rigs]),
        rotation_deg=float(np.degrees(np.sqrt(np.mean(np.arccos(cosines) ** 2)))),
        depths=tuple(_depth_error(fit, rigs, depth) for depth in depths_m),
        working=_depth_error(fit, rigs, working_m),
    )


def expected_ratio(fit: StereoFit, settings: CalibrationSettings) -> float:
    """Return the expected depth error at the working distance, relative to it; NaN = no overlap."""
    depth_m = _working_distance(fit.calibration, settings)
    return _depth_error(fit, _resample(fit), depth_m).calibration_m / depth_m


def _working_distance(rig: StereoCalibration, settings: CalibrationSettings) -> float:
    """Return the distance at which depth matters: by default, where matching errs by 2 %."""
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


def _interval(values: list[float]) -> tuple[float, float]:
    aside = (1 - CONFIDENCE) / 2
    low, high = np.nanquantile(values, (aside, 1 - aside))
    return float(low), float(high)


def _depth_error(fit: StereoFit, rigs: list[StereoCalibration], depth_m: float) -> DepthError:
    rig = fit.calibration
    left_seen, right_seen = (seen_cells(fit, side) for side in (0, 1))
    size = rig.left.width_px, rig.left.height_px
    places = np.concatenate([np.array([size]) / 2, (np.argwhere(left_seen) + 0.5) / CELLS * size])
    xyz = rays_of(rig.left, places) * depth_m
    right_px = project_into_image(rig.right, apply(rig.T_right_left, xyz))
    shared = np.asarray(np.isfinite(right_px).all(axis=1))
    focal_px = float(rig.left.matrix[0, 0])
    matching_m = depth_m**2 * MATCH_SIGMA_PX / (focal_px * rig.baseline_m)
    if not shared[0]:
        return DepthError(depth_m, np.nan, np.nan, np.nan, matching_m)
    # Elsewhere the lens is extrapolated, of which the coverage tells.
    shared[shared] = right_seen[cells_of(right_px[shared], size)]
    shared[0] = True
    errors = np.array([measure_depth(r, places[shared], right_px[shared]) for r in rigs]) - depth_m
    low_m, high_m = _interval(list(errors[:, 0]))
    # The few resamples that determine a lens badly do not count for more than they are. NaN: the
    # lens of one may not be invertible at the image border.
    aside = (1 - _ONE_SIGMA) / 2
    low, high = np.nanquantile(errors, (aside, 1 - aside), axis=0)
    rms_m = float(np.sqrt(np.nanmean(((high - low) / 2) ** 2)))
    return DepthError(depth_m, rms_m, low_m, high_m, matching_m)


def cells_of(pixels: Float64, size: Size) -> tuple[NDArray[np.intp], ...]:
    """Return column and row (N,) of the cells of an image in which pixels (N, 2) are."""
    cells = np.floor((pixels + 0.5) / size * CELLS).astype(np.intp)
    return tuple(np.clip(cells, 0, np.array(CELLS) - 1).T)


def seen_cells(fit: StereoFit, side: int) -> Bool:
    """Return bool `CELLS`: in which cells of an image a corner was seen."""
    seen, camera = np.zeros(CELLS, dtype=bool), fit.state.cameras[side]
    for view in fit.views:
        seen[cells_of(view.seen[side].pixels, (camera.width_px, camera.height_px))] = True
    return seen


def distances_m(fit: StereoFit) -> Float64:
    """Return float64 (V,), distance of the middle of the board from the left camera."""
    middles = [
        (T @ [*view.seen[0].board_m.mean(axis=0), 1.0])[:3]
        for T, view in zip(fit.state.T_rig_board, fit.views, strict=True)
    ]
    return np.asarray(np.linalg.norm(middles, axis=1))
