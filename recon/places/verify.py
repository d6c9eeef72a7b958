"""Geometric verification of loops: the motion between two stereo frames from points both see."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Final

import cv2
import numpy as np
from numpy.typing import NDArray

from recon.core.geometry.alignment import fit_points
from recon.core.geometry.se3 import apply, as_transform, invert, step_jacobian
from recon.core.values import RectifiedCamera
from recon.core.values.arrays import Bool, Float32, Float64, UInt8
from recon.core.values.camera import project
from recon.places.keyframe import Keyframe, coarse_grid, coarse_points, feature_sigma_px, points_of
from recon.places.places import Loop

_CELLS: Final = 4
_MAX_HAMMING: Final = 72  # largest Hamming distance of a match
_GUIDED_HAMMING: Final = 90  # that of features that are where they should be
_GUIDED_SIGMAS: Final = 4.0  # how far they may be from there
_SPREAD_CELLS: Final = 5  # of 4 by 4 cells of each image, how many must hold inliers
_MAX_SIGMA_M: Final = 0.3  # loops less certain than this, on a road, in any direction are refused
_DENSE_TOLERANCE_PX: Final = 1.0
"""Largest difference between a predicted and a seen disparity that agree."""

_DENSE_TOLERANCE_RATIO: Final = 0.03  # fraction of the disparity that is added to it
_MIN_DENSE_RATIO: Final = 0.75  # least fraction of the dense points that agree
_MIN_DENSE_POINTS: Final = 50  # least number of dense points that both frames see


@dataclass(frozen=True, eq=False)
class Verdict:
    """The result of a verification."""

    loop: Loop | None  # the loop; None = refused
    refused: str = ""  # why; "" where there is a loop


def verify(
    first: Keyframe,
    last: Keyframe,
    camera: RectifiedCamera,
    first_camera: RectifiedCamera | None = None,
    scale: float = 1.0,
) -> Verdict:
    """Whether two keyframes show the same place.

    Matches must be mutually best. The motions found in either direction must be inverse to each
    other. The inliers must be many, a fair fraction of the matches, spread over both images, and
    determine the motion in all directions. The coarse disparities must agree with it, too.
    """
    cameras = (first_camera or camera, camera)
    aligned = _aligned(Matchable.of(first, cameras[0]), Matchable.of(last, cameras[1]), scale)
    if isinstance(aligned, str):
        return Verdict(None, aligned)
    T, inliers = aligned.T_first_last, int(aligned.agree.sum())
    dense = dense_agreement(first, last, T, *cameras)
    if dense < _MIN_DENSE_RATIO:
        return Verdict(None, "surfaces differ")
    return Verdict(Loop(first.frame, last.frame, T, aligned.information, inliers, dense))


def _aligned(first: Matchable, last: Matchable, scale: float) -> Alignment | str:
    """The motion between the frames, or why it is not verified."""
    found = find_motion(*_seen(first, last, first.mutual(last)))
    if found is None:
        return "no common motion"
    near = match_near(first, last, found.T_first_last)
    if near is None:
        return "few inliers"
    pairs, aligned = near
    if min(_spread(one) for one in _seen(first, last, pairs)) < _SPREAD_CELLS:
        return "inliers in one corner"
    # How certain the translation is in its worst direction, if it is known in all.
    values = np.linalg.eigvalsh(aligned.information)
    if values[0] <= 1e-9 * values[-1]:
        return "motion not fixed"
    worst = np.linalg.eigvalsh(np.linalg.inv(aligned.information)[:3, :3])[-1]
    return "motion not fixed" if np.sqrt(worst) > scale * _MAX_SIGMA_M else aligned


def match_near(
    first: Matchable, last: Matchable, T_first_last: Float64
) -> tuple[NDArray[np.intp], Alignment] | None:
    """Return the features (M, 2) that agree on a motion near a given one, and it; None = too few.

    Where it is known where features should be, fewer have to be told apart.
    """
    pairs = first.guided(last, T_first_last)
    aligned = refine_motion(*_seen(first, last, pairs), T_first_last)
    if aligned is None or int(aligned.agree.sum()) < MIN_INLIERS:
        return None
    return pairs[aligned.agree], aligned


@dataclass(frozen=True, eq=False)
class Matchable:
    """The features of a keyframe that have a depth."""

    uvd: Float64  # (N, 3), column, row, disparity
    xyz: Float64  # (N, 3), in camera axes
    descriptors: UInt8  # (N, 32)
    camera: RectifiedCamera

    @staticmethod
    def of(keyframe: Keyframe, camera: RectifiedCamera) -> Matchable:
        known = np.isfinite(keyframe.uvd[:, 2])
        uvd = keyframe.uvd[known].astype(np.float64)
        return Matchable(uvd, points_of(uvd, camera), keyframe.descriptors[known], camera)

    def mutual(self, other: Matchable) -> NDArray[np.intp]:
        """Return int (M, 2), features that are each other's best match."""
        if not len(self.uvd) or not len(other.uvd):
            return np.zeros((0, 2), np.intp)
        found = cv2.BFMatcher(cv2.NORM_HAMMING, crossCheck=True)
        pairs = [
            (match.queryIdx, match.trainIdx)
            for match in found.match(self.descriptors, other.descriptors)
            if match.distance <= _MAX_HAMMING
        ]
        return np.array(pairs, np.intp).reshape(-1, 2)

    def guided(self, other: Matchable, T_self_other: Float64) -> NDArray[np.intp]:
        """Return int (M, 2), for features the other's best match near where a motion takes it."""
        u, v, _ = project(apply(T_self_other, other.xyz), self.camera)
        radius_px = _GUIDED_SIGMAS * feature_sigma_px(self.camera)
        with np.errstate(invalid="ignore"):
            near = (self.uvd[:, :1] - u) ** 2 + (self.uvd[:, 1:2] - v) ** 2 <= radius_px**2
        rows, columns = np.nonzero(near)
        bits = np.full(near.shape, 8 * _GUIDED_HAMMING)
        differ = self.descriptors[rows] ^ other.descriptors[columns]
        bits[rows, columns] = np.bitwise_count(differ).sum(axis=1)
        best, best_back = bits.argmin(axis=1), bits.argmin(axis=0)
        ours = np.flatnonzero(best_back[best] == np.arange(len(best)))
        ours = ours[bits[ours, best[ours]] <= _GUIDED_HAMMING]
        return np.column_stack([ours, best[ours]])


def _seen(first: Matchable, last: Matchable, pairs: NDArray[np.intp]) -> tuple[Seen, Seen]:
    ones, others = (
        Seen(k.uvd[rows], k.xyz[rows], k.camera, feature_sigma_px(k.camera))
        for k, rows in zip((first, last), pairs.T, strict=True)
    )
    return ones, others


def dense_agreement(
    first: Keyframe,
    last: Keyframe,
    T_first_last: Float64,
    first_camera: RectifiedCamera,
    last_camera: RectifiedCamera,
) -> float:
    """The fraction of coarse disparities that the other frame confirms, in the worse direction.

    A smaller disparity than predicted means seeing through the other's surface: a contradiction. A
    larger one means that something is in front of it, which does not count. 0 where the two frames
    hardly overlap.
    """
    return min(
        _confirmed(coarse_points(last.coarse, last_camera), first, T_first_last, first_camera),
        _confirmed(
            coarse_points(first.coarse, first_camera), last, invert(T_first_last), last_camera
        ),
    )


def _confirmed(
    xyz: Float64, target: Keyframe, T_target_source: Float64, camera: RectifiedCamera
) -> float:
    """The fraction of points of another frame that the target sees where they should be."""
    u, v, d = project(apply(T_target_source, xyz), camera)
    step, half = coarse_grid(target.coarse, camera)
    off = _interpolated(target.coarse, (u - half) / step, (v - half) / step) - d
    tolerance = _DENSE_TOLERANCE_PX + _DENSE_TOLERANCE_RATIO * np.abs(d)
    with np.errstate(invalid="ignore"):
        comparable = off <= tolerance  # False for NaN, unknown in one of the frames
    if int(comparable.sum()) < _MIN_DENSE_POINTS:
        return 0.0
    return float(np.mean(off[comparable] >= -tolerance[comparable]))


def _interpolated(values: Float32, column: Float64, row: Float64) -> Float64:
    """Values (N,) between samples; NaN beyond them, or where one of the four is unknown."""
    rows, columns = values.shape
    with np.errstate(invalid="ignore"):
        inside = (column >= 0) & (column < columns - 1) & (row >= 0) & (row < rows - 1)
    x, y = np.where(inside, column, 0.0), np.where(inside, row, 0.0)
    i, j = y.astype(np.intp), x.astype(np.intp)
    i1, j1 = np.minimum(i + 1, rows - 1), np.minimum(j + 1, columns - 1)
    x, y = x - j, y - i
    upper = (1 - x) * values[i, j] + x * values[i, j1]
    lower = (1 - x) * values[i1, j] + x * values[i1, j1]
    return np.where(inside, (1 - y) * upper + y * lower, np.nan)


def _spread(seen: Seen) -> int:
    """Return how many of 4 by 4 cells of the image hold a feature."""
    uvd, camera = seen.uvd, seen.camera
    column = np.clip(uvd[:, 0] * _CELLS / camera.width_px, 0, _CELLS - 1).astype(int)
    row = np.clip(uvd[:, 1] * _CELLS / camera.height_px, 0, _CELLS - 1).astype(int)
    return len(np.unique(row * _CELLS + column))


MIN_INLIERS: Final = 15  # least number of matches that agree in both directions
_LIMIT_SIGMAS: Final = 2.5  # largest distance from where a match should be, in each frame
_MOST: Final = 300  # matches that are compared with one another, those of the nearest points
_SEEDS: Final = 6  # matches whose companions are tried
_ROUGH: Final = 4  # steps of the fit to them
_FEWEST: Final = 8  # least number of companions
SIGMA_D_PX: Final = 1.0  # standard deviation of a disparity
_STEPS: Final = 15
_ROUNDS: Final = 3
_STILL: Final = 1e-5  # baselines and radians: a step that ends the fit
_NEAREST: Final = 0.2  # of the baseline: what is nearer is not in both views
CAUCHY_SIGMAS: Final = 2.0
_SHARED: Final = 0.5  # both directions see the same matches, so together they count once


@dataclass(frozen=True, eq=False)
class Seen:
    """Matched points as one frame sees them."""

    uvd: Float64  # (N, 3), column, row, disparity
    xyz: Float64  # (N, 3), the same points in camera axes
    camera: RectifiedCamera  # that of the frame
    sigma_px: float  # standard deviation of a column or row

    def select(self, rows: NDArray[np.bool_] | NDArray[np.intp]) -> Seen:
        return Seen(self.uvd[rows], self.xyz[rows], self.camera, self.sigma_px)

    @property
    def sigma_m(self) -> Float64:
        """float64 (N,), about how far each point may be off."""
        depth, camera = self.xyz[:, 2], self.camera
        along = depth**2 / (camera.focal_px * camera.baseline_m) * SIGMA_D_PX
        return np.asarray(np.hypot(along, depth / camera.focal_px * self.sigma_px))


@dataclass(frozen=True, eq=False)
class Alignment:
    """A motion between two frames."""

    T_first_last: Float64  # (4, 4)
    agree: Bool  # (N,), matches that agree with it in both views
    # float64 (6, 6) of a step (translation in metres, rotation vector in radians) in the axes of
    # the last frame
    information: Float64


def find_motion(first: Seen, last: Seen) -> Alignment | None:
    """Return the motion on which most matches agree; None = too few do.

    A motion keeps the distances between points. The companions of a match are those that are as far
    from it in either frame, within what depth errors explain. Of the matches with most companions
    each gives a motion; the one that most matches agree with is fitted to them.

    Ref: Leordeanu and Hebert, "A spectral technique for correspondence problems using pairwise
    constraints", ICCV 2005.
    """
    near = np.argsort(first.sigma_m + last.sigma_m, kind="stable")[:_MOST]
    ones, others = first.select(near), last.select(near)
    rigid = _keep_distances(ones, others)
    sigma_m = np.hypot(ones.sigma_m, others.sigma_m)
    best, T_best = 0, np.eye(4)
    for seed in np.argsort(-rigid.sum(axis=1), kind="stable")[:_SEEDS]:
        # Companions of the seed that are companions of at least half of the others.
        among = np.flatnonzero(rigid[seed])
        mutual = rigid[np.ix_(among, among)].sum(axis=1)
        among = np.append(among[2 * mutual >= len(among)], seed)
        if len(among) < _FEWEST:
            continue
        # Depth errors grow with the square of the distance: the nearer half tells most.
        surest = among[np.argsort(sigma_m[among], kind="stable")[: max(_FEWEST, len(among) // 2)]]
        T = fit_points(others.xyz[surest], ones.xyz[surest]).T_to_from
        T = refine(ones.select(among), others.select(among), T, steps=_ROUGH).T_first_last
        agreeing = int(agreement(first, last, T).sum())
        if agreeing > best:
            best, T_best = agreeing, T
    return refine_motion(first, last, T_best) if best >= _FEWEST else None


def refine_motion(first: Seen, last: Seen, T_first_last: Float64) -> Alignment | None:
    """Fit a motion to the matches that agree with it, until these stay the same; None = too few."""
    agree = agreement(first, last, T_first_last)
    for _ in range(_ROUNDS):
        if agree.sum() < _FEWEST:
            return None
        found = refine(first.select(agree), last.select(agree), T_first_last)
        T_first_last, before = found.T_first_last, agree
        agree = agreement(first, last, T_first_last)
        if np.array_equal(agree, before):
            break
    return Alignment(T_first_last, agree, found.information)


def _keep_distances(first: Seen, last: Seen) -> Bool:
    """Return bool (N, N), which matches are as far from one another in either frame."""
    apart = [np.linalg.norm(seen.xyz[:, None] - seen.xyz, axis=2) for seen in (first, last)]
    variance = first.sigma_m**2 + last.sigma_m**2
    tolerance = np.sqrt(variance[:, None] + variance)
    # Points that errors of their depth do not tell apart say nothing of one another.
    alike = np.abs(apart[0] - apart[1]) <= tolerance
    return np.asarray(alike & (np.minimum(*apart) > tolerance))


def refine(first: Seen, last: Seen, T_first_last: Float64, *, steps: int = _STEPS) -> Alignment:
    """Fit the motion to columns, rows and disparities in both frames, with Cauchy weights."""
    T, units = T_first_last, np.repeat([last.camera.baseline_m, 1.0], 3)
    for _ in range(steps):
        H, g = _normal_equations(first, last, T)
        step = np.linalg.solve(H + 1e-9 * np.eye(6), -g)
        T = T @ as_transform(step)
        if np.linalg.norm(step / units) < _STILL:
            break
    H, _ = _normal_equations(first, last, T)
    return Alignment(T, agreement(first, last, T), _SHARED * H)


def agreement(first: Seen, last: Seen, T_first_last: Float64) -> Bool:
    """Return bool (N,), matches whose reprojection error is within the limit in both frames."""
    agree = np.ones(len(first.xyz), np.bool_)
    both = (T_first_last, last.xyz, first), (invert(T_first_last), first.xyz, last)
    for T, points, seen in both:
        u, v, _ = project(apply(T, points), seen.camera)
        # A point behind the camera has a NaN error, which compares as False.
        off_px = np.hypot(u - seen.uvd[:, 0], v - seen.uvd[:, 1])
        agree &= off_px <= _LIMIT_SIGMAS * seen.sigma_px
    return agree


def _normal_equations(first: Seen, last: Seen, T: Float64) -> tuple[Float64, Float64]:
    """Return Gauss-Newton's matrix (6, 6) and gradient (6,) for a step in the axes of ``last``."""
    H, g = np.zeros((6, 6)), np.zeros(6)
    # Points of the last frame, seen by the first: they move with the step.
    moved = apply(T, last.xyz)
    turn = T[:3, :3] @ step_jacobian(last.xyz)
    # Points of the first frame, seen by the last: they move against it.
    back = apply(invert(T), first.xyz)
    for xyz, d_xyz, seen in ((moved, turn, first), (back, -step_jacobian(back), last)):
        r, J = _residuals(xyz, d_xyz, seen)
        weight = 1.0 / (1.0 + np.einsum("nk,nk->n", r, r) / CAUCHY_SIGMAS**2)
        H += np.einsum("nki,n,nkj->ij", J, weight, J)
        g += np.einsum("nki,n,nk->i", J, weight, r)
    return H, g


def _residuals(xyz: Float64, d_xyz: Float64, seen: Seen) -> tuple[Float64, Float64]:
    """Return whitened residuals (N, 3) and derivatives (N, 3, 6); 0 for points behind a camera."""
    sigma, camera = np.array([seen.sigma_px, seen.sigma_px, SIGMA_D_PX]), seen.camera
    f, b = camera.focal_px, camera.baseline_m
    front = xyz[:, 2] > _NEAREST * b
    z = np.where(front, xyz[:, 2], 1.0)
    u, v = f * xyz[:, 0] / z + camera.cx_px, f * xyz[:, 1] / z + camera.cy_px
    predicted = np.stack([u, v, f * b / z - camera.doffs_px], axis=1)
    J = np.zeros((len(xyz), 3, 3))
    J[:, 0, 0] = J[:, 1, 1] = f / z
    J[:, 0, 2], J[:, 1, 2] = -f * xyz[:, 0] / z**2, -f * xyz[:, 1] / z**2
    J[:, 2, 2] = -f * b / z**2
    J = np.where(front[:, None, None], J @ d_xyz / sigma[:, None], 0.0)
    return np.where(front[:, None], (predicted - seen.uvd) / sigma, 0.0), J
