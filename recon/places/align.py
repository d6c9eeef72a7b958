"""The motion between two stereo frames from points that both see, symmetric in the two."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Final

import numpy as np
from numpy.typing import NDArray

from recon.core.geometry.alignment import fit_points
from recon.core.geometry.se3 import apply, as_transform, invert, step_jacobian
from recon.core.values import RectifiedCamera
from recon.core.values.arrays import Bool, Float64
from recon.core.values.camera import project

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
        among = _companions(rigid, int(seed))
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


def _companions(rigid: Bool, seed: int) -> NDArray[np.intp]:
    """Return the companions of a match that are companions of at least half of the others."""
    among = np.flatnonzero(rigid[seed])
    mutual = rigid[np.ix_(among, among)].sum(axis=1)
    return np.append(among[2 * mutual >= len(among)], seed)


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
