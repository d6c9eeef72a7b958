"""The fault of a rig with which disparities fit the motion, and rows meet.

Bundle adjustment of a few windows that share the fault; poses and points are eliminated.

The formal error of a path takes features as independent. What is left of the fault of a rig is not:
all that is on one side of the image, near, or low is off alike. So each window is adjusted twice,
with what lies on either side, above and below, near and far: estimates of one motion that share no
feature. Half of their difference is what the two together may be off by.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace
from typing import Final, NamedTuple

import numpy as np
from numpy.typing import NDArray

from recon.core.geometry.se3 import apply, invert
from recon.core.text import round_lengths
from recon.core.values import RectifiedCamera
from recon.core.values.arrays import Bool, Float64
from recon.core.values.camera import depth_from_disparity, project
from recon.core.work import FEW, serial_algebra, side_by_side
from recon.look.fault import Places, RigFault, shrink
from recon.look.tracks import StereoTracks, turns
from recon.odometry.kernels import bundle
from recon.odometry.pose import (
    CAUCHY_SIGMAS,
    MIN_INLIERS,
    SIGMA_D_PX,
    SIGMA_UV_PX,
    TrackWindow,
    adjust,
    linearise,
    model_of,
    reprojection,
)

ROAD_DEPTH_M: Final = 10.0
_ROUNDS: Final = 32  # times at most that all windows are adjusted, without the fault as known then
_LAST_STEP: Final = 1.0  # length of a step, in standard deviations, after which there is no other
_ROUNDING: Final = 1e-9  # fraction of the best known direction below which one is not known at all
_RECALLED: Final = 4  # last rounds that the next one learns from
_FIRST: Final = 4  # every so many-th track is fitted first, so that few rounds take all of them
_QUARTERS: Final = 4  # parts of the features of a window that lie alike
_ENOUGH: Final = 100  # tracks of a window that show by how much it depends on where they lie
_ROW_SIGMA_PX: Final = 0.3  # standard deviation of the row of a feature in the right image
_IN_STEP: Final = 0.02
"""Frames by which right images may seem late where one trigger takes both: on drives with one it is
0.005 at most. Cameras that run freely are as near to each other once in 25 times."""
_LATE_SIGMA: Final = 12.0**-0.5
"""Frames by which right images are late, standard deviation beforehand: cameras that run freely are
paired with the nearest image, at any time within half a frame before or after."""


@dataclass(frozen=True, eq=False)
class FittedFault:
    """The parameters (P,) of a fault, and what is known of them."""

    values: Float64
    covariance: Float64  # (P, P), mean squares of their errors, by shrinking as well
    lengthening: Float64  # (P,), by what ratio the path becomes longer with each
    scatter: float  # how much more windows contradict each other than their features say, 1 or more
    windows: int
    time_offset: float = 0.0  # frames by which right images are taken later than left ones
    time_offset_sigma: float = float("nan")
    spread: float = 1.0  # variance of what lenses bend, in that expected beforehand, 1 or more
    fixed: bool = True  # False: it turns with what is seen, as in stabilised images
    # standard deviation of the path's length without the fault, as a ratio; NaN = as the covariance
    length: float = float("nan")
    depth_m: float = ROAD_DEPTH_M  # a typical one of what moved


def fit_fault(
    tracks: Sequence[StereoTracks],
    fault: RigFault,
    active: Bool,
    before: FittedFault | None = None,
    moved: Float64 | None = None,
) -> FittedFault:
    """Fit the ``active`` parameters to windows of tracks; the others are 0.

    What late right images do to moving features, which in curves looks like a turned camera, is
    fitted with them.

    What an earlier drive of the same rig knew ``before`` counts as windows of this one in which the
    rig has no fault, as far as this drive does not contradict it. ``moved`` are parameters (P,) by
    which the rig was corrected before.

    Features of a window err together. By how much windows contradict each other beyond what their
    features let expect, what they know counts less; and so it does by how much it depends on where
    features lie, since those that lie alike err alike in all windows.

    What is wrong with a rig stays where it is in the images. Where it turns with what is seen
    instead, no rig explains it, and nothing is corrected.

    Ref: Liang and Zeger, "Longitudinal data analysis using generalized linear models", 1986 (the
    covariance of clustered data); Efron, "The jackknife, the bootstrap and other resampling plans",
    1982.
    """
    active, camera = np.append(active, True), fault.camera
    sigmas = np.append(fault.sigmas, _LATE_SIGMA)[active]
    prior, scatter = np.diag(1.0 / sigmas**2), 1.0
    values, windows = np.zeros(len(active)), [part.window for part in tracks]
    held = np.zeros_like(prior)  # of what was known before
    few = [part.thinned(_FIRST) for part in tracks]

    def linearised(part: StereoTracks, window: TrackWindow) -> tuple[TrackWindow, _System]:
        places, window = _corrected(part, window, fault, values)
        window = adjust(window, camera)
        return window, _system(window, places, camera)

    for parts in (few, tracks):
        # As they were moved by the parts before.
        poses = [window.T_world_camera for window in windows]
        windows = [
            replace(part.window, T_world_camera=T) for part, T in zip(parts, poses, strict=True)
        ]
        tried, stepped = list[Float64](), list[Float64]()
        for _ in range(_ROUNDS):
            with serial_algebra():
                each = zip(parts, windows, strict=True)
                found = list(side_by_side(lambda pair: linearised(*pair), each, threads=FEW))
            windows = [window for window, _ in found]
            H = np.stack([system.H for _, system in found])[:, active][:, :, active]
            g = np.stack([system.g for _, system in found])[:, active]
            total = _information(H.sum(axis=0), sigmas)
            seen, pull = total / scatter, g.sum(axis=0) / scatter
            if before is not None:
                known = np.diag(sigmas**2)
                known[:-1, :-1] = before.covariance[np.ix_(active[:-1], active[:-1])]
                held = _not_contradicted(known, seen, pull + seen @ values[active]) - prior
                held = _information(held, sigmas)
            shown = seen + held
            step = np.linalg.solve(shown + prior, pull - (held + prior) @ values[active])
            tried, stepped = [*tried, values[active]][-_RECALLED:], [*stepped, step][-_RECALLED:]
            values[active] = _accelerated(tried, stepped, shown + prior)
            scatter = _scatter(total + prior, total, g - H @ step)
            if step @ (shown + prior) @ step < _LAST_STEP**2:
                break
    rig, covariance = active[:-1], np.zeros((len(active) - 1,) * 2)
    parts = [
        replace(part, window=replace(window, uvd=part.window.uvd))
        for part, window in zip(tracks, windows, strict=True)
    ]
    off = _by_likeness(parts, fault, values, active, (held + prior) * scatter)
    own, shown, time_offset, sigma = _without_time_offset(values[active], shown, sigmas)
    moved = None if moved is None else moved[rig]
    values[:-1][rig], squares, spread = shrink(own, shown, sigmas[:-1], moved)
    covariance[np.ix_(rig, rig)], lengthening = squares, _lengthening(found)[:-1]
    fixed = not turns(tracks, fault, values[:-1])
    if not fixed:
        covariance += np.outer(values[:-1], values[:-1])
        values[:-1] = 0.0
    # What misleads the rig misleads the path alike: of its length, its own features tell. In it
    # nothing is corrected of late images.
    used = np.append(values[:-1], 0.0)
    apart = disagreement([_corrected(part, part.window, fault, used)[1] for part in parts], camera)
    length = float(np.sqrt(lengthening @ covariance @ lengthening + apart**2))
    covariance[np.ix_(rig, rig)] += off[:-1, :-1]
    others = (time_offset, sigma, spread, fixed, length, _typical_depth(tracks, camera))
    return FittedFault(values[:-1], covariance, lengthening, scatter, len(tracks), *others)


def _typical_depth(tracks: Sequence[StereoTracks], camera: RectifiedCamera) -> float:
    """Return the median depth of features, of the series 1, 2, 5; of a road if it is not known."""
    depth_m = depth_from_disparity(
        np.concatenate([one.window.uvd[-1, :, 2] for one in tracks]), camera
    )
    known = depth_m[np.isfinite(depth_m)]
    return round_lengths(*[float(np.median(known))] * 2)[0] if len(known) else ROAD_DEPTH_M


def _by_likeness(
    parts: Sequence[StereoTracks], fault: RigFault, values: Float64, active: Bool, prior: Float64
) -> Float64:
    """Return mean squares (P, P) of errors that features share which lie alike.

    They are by how much parameters change without a quarter of them, the leftmost for instance.
    """

    def left(part: StereoTracks) -> tuple[Float64, Float64]:
        part, found = part.thinned(every := max(1, part.right_uv.shape[1] // _ENOUGH)), []
        places, window = _corrected(part, part.window, fault, values)
        for at in _without_quarters(part.window, fault.camera):
            fewer = replace(window, uvd=window.uvd[:, at], xyz_world=window.xyz_world[at])
            found.append(_system(fewer, places.chosen(at), fault.camera))
        times = every * _QUARTERS / (_QUARTERS - 1)
        H, g, _ = (times * np.stack(terms) for terms in zip(*found, strict=True))
        return H[:, active][:, :, active], g[:, active] + H[:, active] @ values

    with serial_algebra():
        each = list(side_by_side(left, parts, threads=FEW))
    H, told = (np.sum(terms, axis=0) for terms in zip(*each, strict=True))
    found = np.linalg.solve(H + prior, told[..., None]).reshape(-1, _QUARTERS, len(prior))
    apart = (found - found.mean(axis=1, keepdims=True)).reshape(-1, len(prior))
    return np.asarray(apart.T @ apart) * (_QUARTERS - 1) / _QUARTERS


def _without_quarters(window: TrackWindow, camera: RectifiedCamera) -> Iterator[NDArray[np.int64]]:
    """Yield the points of a window but each quarter: by column, row, disparity, and radius."""
    middle = middles(window)
    radius = np.linalg.norm(middle[:, :2] - [camera.cx_px, camera.cy_px], axis=1)
    for key in (*middle.T, radius):
        quarters = np.array_split(np.argsort(key), _QUARTERS)
        yield from (np.setdiff1d(np.arange(len(key)), quarter) for quarter in quarters)


def _without_time_offset(
    values: Float64, shown: Float64, sigmas: Float64
) -> tuple[Float64, Float64, float, float]:
    """Return the parameters but the last one, and their information; that one apart.

    It is by how many frames right images are late, with its standard deviation. Where it is next
    to nothing, cameras have one trigger, and the others are stated as if it were nothing.
    """
    known = shown + np.diag(1.0 / sigmas**2)
    time_offset, sigma = float(values[-1]), float(np.sqrt(np.linalg.inv(known)[-1, -1]))
    rig, shared = shown[:-1, :-1], known[:-1, -1]
    if abs(time_offset) < max(_IN_STEP, 2.0 * sigma):
        return (
            values[:-1] + np.linalg.solve(known[:-1, :-1], shared) * time_offset,
            rig,
            time_offset,
            sigma,
        )
    return values[:-1], rig - np.outer(shared, shared) / known[-1, -1], time_offset, sigma


def _information(H: Float64, sigmas: Float64) -> Float64:
    """Return an information matrix without what rounding left of directions that nothing shows."""
    D, V = np.linalg.eigh(sigmas[:, None] * (0.5 * (H + H.T)) * sigmas)
    shown = np.where(_ROUNDING * D.max(initial=0.0) < D, D, 0.0)
    return np.asarray((V * shown) @ V.T / np.outer(sigmas, sigmas))


def _not_contradicted(known: Float64, H: Float64, g: Float64) -> Float64:
    """Return the information (P, P) of a covariance that a drive may contradict.

    ``H`` (P, P) is the information of the drive and ``g`` (P,) its gradient where the parameters
    are as was known. Each direction was known as much worse as makes what is seen likely.

    Ref: Efron and Morris, "Stein's estimation rule and its competitors", 1973 (empirical Bayes).
    """
    root = np.linalg.cholesky(known)
    D, V = np.linalg.eigh(root.T @ H @ root)
    squared = (V.T @ (root.T @ g)) ** 2  # of a rig that has not changed, D² + D
    usual = np.maximum(D, 0.0) ** 2
    most = np.maximum(squared - D, usual)
    ratio = np.divide(usual, most, where=most > 0.0, out=np.ones_like(D))
    axes = np.linalg.solve(root.T, V)
    return np.asarray((axes * ratio) @ axes.T)


def _accelerated(tried: Sequence[Float64], steps: Sequence[Float64], metric: Float64) -> Float64:
    """Return where steps lead that become ever shorter: weights follow the residuals slowly.

    Ref: Walker and Ni, "Anderson acceleration for fixed-point iterations", 2011.
    """
    x, step = tried[-1], steps[-1]
    whiten = np.linalg.cholesky(metric).T
    if len(tried) == 1 or np.diff(np.linalg.norm(whiten @ np.transpose(steps), axis=0))[-1] > 0.0:
        return np.asarray(x + step)  # nothing to learn from, or it led astray
    by_step = np.diff(steps, axis=0).T
    ratio = np.linalg.lstsq(whiten @ by_step, whiten @ step, rcond=None)[0]
    return np.asarray(x + step - (np.diff(tried, axis=0).T + by_step) @ ratio)


def _scatter(known: Float64, total: Float64, g: Float64) -> float:
    """Return how much the gradients (K, P) of windows vary, relative to their information."""
    inverse, apart = np.linalg.inv(known), g - g.mean(axis=0)
    varied = np.einsum("ki,ij,kj->", apart, inverse, apart) * len(g) / (len(g) - 1)
    return max(1.0, float(varied / np.trace(inverse @ total)))


def _in_time(
    places: Places, window: TrackWindow, camera: RectifiedCamera, time_offset: float
) -> Places:
    """Return where features would be seen if right images were not late, with one parameter more.

    Ref: Qin and Shen, "Online temporal calibration for monocular visual-inertial systems", 2018.
    """
    xyz = np.stack([apply(T, window.xyz_world) for T in invert(window.T_world_camera)])
    step = np.gradient(xyz, axis=0, edge_order=2)
    seen, later = (
        np.stack(project(at.reshape(-1, 3), camera), axis=-1).reshape(xyz.shape)
        for at in (xyz, xyz + time_offset * step)
    )
    moved, motion = (
        later - seen,
        (_derivative(xyz + time_offset * step, camera) @ step[..., None])[..., 0],
    )
    to_right = np.array([[1.0, 0.0, -1.0], [0.0, 1.0, 0.0]])  # of column, row and disparity
    by_left = np.concatenate([places.by_left, np.zeros((*motion.shape[:2], 2, 1))], axis=-1)
    by_right = np.concatenate([places.by_right, -(motion @ to_right.T)[..., None]], axis=-1)
    return Places(places.left_uv, places.right_uv - moved @ to_right.T, by_left, by_right)


def _lengthening(found: Sequence[tuple[TrackWindow, _System]]) -> Float64:
    """Return by what ratio the path of all windows becomes longer with each parameter (P,)."""
    ends = [window.T_world_camera[[0, -1]] for window, _ in found]
    # In the axes of the last frame.
    path_m = np.stack([last[:3, :3].T @ (last[:3, 3] - first[:3, 3]) for first, last in ends])
    lengths_m = np.linalg.norm(path_m, axis=1)
    moved = np.stack([system.moved for _, system in found])
    return np.asarray(np.einsum("kpi,ki->p", moved, path_m / lengths_m[:, None]) / lengths_m.sum())


def _corrected(
    part: StereoTracks, window: TrackWindow, fault: RigFault, values: Float64
) -> tuple[Places, TrackWindow]:
    """Return where features are without the fault, and a window with them there."""
    places = fault.correct(part.window.uvd[..., :2], part.right_uv, values[:-1])
    places = _in_time(places, window, fault.camera, values[-1])
    disparity = places.left_uv[..., :1] - places.right_uv[..., :1]
    return places, replace(window, uvd=np.concatenate([places.left_uv, disparity], axis=2))


class _System(NamedTuple):
    """Normal equations of a further correction."""

    H: Float64  # (P, P)
    g: Float64  # (P,)
    moved: Float64  # (P, 3), by what the last camera moves with each parameter, in its own axes


def _system(window: TrackWindow, places: Places, camera: RectifiedCamera) -> _System:
    """Return the normal equations of a further correction, poses and points eliminated."""
    normal = linearise(window, model_of(camera))
    shared = _of_places(window, places, camera)
    H_rows, g_rows = _of_rows(places)
    frames, points = window.uvd.shape[:2]
    size, parameters = 6 * (frames - 1), places.by_left.shape[-1]
    # The correction follows the poses, of which the first is fixed, as one more block.
    S, g = np.zeros((size + parameters,) * 2), np.zeros(size + parameters)
    for k in range(1, frames):
        at = slice(6 * (k - 1), 6 * k)
        S[at, at], g[at] = normal.H_pose[k], normal.g_pose[k]
        S[at, size:] = shared.H_pose[k]
        S[size:, at] = shared.H_pose[k].T
    S[size:, size:], g[size:] = shared.H + H_rows, shared.g + g_rows
    of_poses = normal.H_cross[1:].transpose(1, 0, 2, 3).reshape(points, size, 3)
    cross = np.concatenate([of_poses, shared.H_point], axis=1)
    folded = cross @ np.linalg.inv(normal.H_point + bundle.RIDGE * np.eye(3))
    S -= np.tensordot(folded, cross, axes=((0, 2), (0, 2)))
    g -= np.tensordot(folded, normal.g_point, axes=((0, 2), (0, 1)))
    ratio = np.linalg.solve(S[:size, :size] + bundle.RIDGE * np.eye(size), S[:size, size:]).T
    H, g = S[size:, size:] - ratio @ S[:size, size:], g[size:] - ratio @ g[:size]
    return _System(H, g, -ratio[:, -6:-3])


class _Shared(NamedTuple):
    """What places say of the correction (P), with the poses (W, 6, P) and points (N, P, 3)."""

    H: Float64
    g: Float64
    H_pose: Float64
    H_point: Float64


def _of_rows(places: Places) -> tuple[Float64, Float64]:
    """Return normal equations of epipolar errors (W, N), which neither pose nor depth changes."""
    error = places.right_uv[..., 1] - places.left_uv[..., 1]
    residual = np.nan_to_num(error) / _ROW_SIGMA_PX
    weight = np.isfinite(error) / (1.0 + (residual / CAUCHY_SIGMAS) ** 2)
    by = np.nan_to_num(places.by_right[:, :, 1] - places.by_left[:, :, 1]) / _ROW_SIGMA_PX
    J = by.reshape(residual.size, by.shape[-1])
    weighed = weight.reshape(-1, 1) * J
    # A correction moves the observed row: it is to take the error away.
    return weighed.T @ J, -weighed.T @ residual.ravel()


def _of_places(window: TrackWindow, places: Places, camera: RectifiedCamera) -> _Shared:
    T_camera_world = invert(window.T_world_camera)
    sigmas = np.array([SIGMA_UV_PX, SIGMA_UV_PX, SIGMA_D_PX])
    # Residuals in sigmas, 0 where unseen, and the weights of `adjust`.
    residual = np.nan_to_num(reprojection(window, camera) / sigmas)
    square = np.square(residual).sum(axis=2)
    weight = window.seen / (1.0 + square / CAUCHY_SIGMAS**2)
    frames, points = weight.shape
    xyz = np.stack([apply(T, window.xyz_world) for T in T_camera_world])
    by_place = _derivative(xyz, camera)
    by = [places.by_left, (places.by_left - places.by_right)[:, :, :1]]
    # A correction moves what is observed, a step what is predicted: hence the sign.
    J = -np.nan_to_num(np.concatenate(by, axis=2)) / sigmas[:, None]
    # What has no disparity has no residual and no derivative of one.
    by_place = by_place * np.isfinite(window.uvd)[..., None] / sigmas[:, None]
    by_pose = np.concatenate([-by_place, np.cross(by_place, xyz[:, :, None])], axis=3)
    by_point = by_place @ T_camera_world[:, None, :3, :3]
    weighed = weight[:, :, None, None] * J
    flat = weighed.reshape(frames, 3 * points, J.shape[-1])
    whole = flat.reshape(3 * frames * points, J.shape[-1])
    by_track = weighed.transpose(1, 3, 0, 2).reshape(points, J.shape[-1], 3 * frames)
    return _Shared(
        H=whole.T @ J.reshape(whole.shape),
        g=whole.T @ residual.ravel(),
        H_pose=by_pose.reshape(frames, 3 * points, 6).transpose(0, 2, 1) @ flat,
        H_point=by_track @ by_point.transpose(1, 0, 2, 3).reshape(points, 3 * frames, 3),
    )


def _derivative(xyz: Float64, camera: RectifiedCamera) -> Float64:
    """Return how column, row and disparity follow a place in camera axes: (W, N, 3, 3)."""
    f, fb = camera.focal_px, camera.focal_px * camera.baseline_m
    z = np.maximum(xyz[..., 2], bundle.NEAREST * camera.baseline_m)
    x, y, zero = xyz[..., 0] / z, xyz[..., 1] / z, np.zeros_like(z)
    rows = [f / z, zero, -f * x / z], [zero, f / z, -f * y / z], [zero, zero, -fb / z**2]
    return np.stack([np.stack(row, -1) for row in rows], axis=-2)


def disagreement(windows: Sequence[TrackWindow], camera: RectifiedCamera) -> float:
    """Return the standard deviation of a path's length by halves of the features, as a ratio.

    That of the halves that disagree most: what is near is low, too, so that theirs do not add up.
    ``windows`` are seen with the rig of the path; those with too few features to be halved do not
    count. NaN = there are no others.
    """

    def measured(window: TrackWindow) -> list[float]:
        every = np.ones(len(window.xyz_world), np.bool_)
        # The left, the upper and the farther points.
        halves = [one < np.median(one) for one in middles(window).T] if every.any() else []
        if min((int(half.sum()) for half in halves), default=0) < MIN_INLIERS:
            return []
        lengths_m = [[_length_m(window, part, camera) for part in (half, ~half)] for half in halves]
        return [_length_m(window, every, camera), *(one - other for one, other in lengths_m)]

    with serial_algebra():
        found = [one for one in side_by_side(measured, windows, threads=FEW) if one]
    if not found:
        return float("nan")
    length_m, *apart_m = np.sum(found, axis=0)
    return 0.5 * float(np.abs(apart_m).max() / length_m)


def middles(window: TrackWindow) -> Float64:
    """Return where points are in the middle of their tracks: column, row, disparity (N, 3)."""
    return np.asarray(np.nansum(window.uvd, axis=0) / np.isfinite(window.uvd).sum(axis=0).clip(1))


def _length_m(window: TrackWindow, chosen: Bool, camera: RectifiedCamera) -> float:
    """Return how far the camera moved through a window, by some of its points."""
    part = TrackWindow(window.T_world_camera, window.uvd[:, chosen], window.xyz_world[chosen])
    first, last = adjust(part, camera).T_world_camera[[0, -1]]
    return float(np.linalg.norm((invert(first) @ last)[:3, 3]))
