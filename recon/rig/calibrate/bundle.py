"""Bundle adjustment of the lenses, the pose of the right camera and every pose of the board.

One solver handles one or two cameras, any lens, and partly visible boards. Board poses are
eliminated view by view (Schur complement); the bootstrap reweights what is left of each view.

Ref: Triggs et al. 2000, "Bundle adjustment: a modern synthesis", section 6; Zhang 2000.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Final

import numpy as np
from numpy.typing import NDArray

from recon.core.errors import CalibrationError
from recon.core.geometry.alignment import Problem, minimise
from recon.core.geometry.se3 import apply, exp_so3, make_transform, orthonormalise, step_jacobian
from recon.core.values import CameraIntrinsics
from recon.core.values.arrays import Float64, Int32
from recon.stereo.rectify.lens import project_raw, project_with_jacobian

_ROUNDS: Final = 100
_STILL: Final = 1e-12  # relative decrease of the cost at which the solver has converged
# The eight coefficients of a rational lens are not all observable: each has a zero-mean prior of
# this standard deviation, against corners measured to 0.1 px.
_PRIOR_SPREAD: Final = 2.0
_PRIOR_PX: Final = 0.1
_POSE: Final = 6


@dataclass(frozen=True, eq=False)
class Sighting:
    """Board corners that one camera saw in one view: (N,) numbers, (N, 3) metres, (N, 2) px."""

    numbers: Int32
    board_m: Float64
    pixels: Float64


@dataclass(frozen=True, eq=False)
class View:
    """One pose of the board, named for the user, with a sighting of each camera."""

    name: str
    seen: tuple[Sighting, ...]


@dataclass(frozen=True, eq=False)
class RigState:
    """Everything that is estimated: one or two cameras, the first at the origin of the rig."""

    cameras: tuple[CameraIntrinsics, ...]
    T_camera_rig: tuple[Float64, ...]  # (4, 4) of each camera
    T_rig_board: Float64  # (V, 4, 4), of the board in each view


@dataclass(frozen=True, eq=False)
class _Corners:
    """All corners that one camera saw, view after view; ``view`` (N,) numbers their views."""

    board_m: Float64
    pixels: Float64
    view: NDArray[np.intp]

    def in_rig(self, state: RigState) -> Float64:
        """Return float64 (N, 3), the corners in the axes of the rig."""
        T = state.T_rig_board[self.view]
        return np.asarray((T[:, :3, :3] @ self.board_m[:, :, None])[:, :, 0] + T[:, :3, 3])


@dataclass(frozen=True, eq=False)
class Information:
    """Information of each view about the shared parameters, at the solution.

    These (P) are (fx, fy, cx, cy, distortion …) of each camera in turn and, with two cameras, the
    pose of the right one: rotation and translation of a small motion after it.
    """

    matrices: Float64  # (V, P, P), information matrix of each view, board poses eliminated
    vectors: Float64  # (V, P), gradient of each view; their weighted sum is zero
    prior: Float64  # (P, P), information matrix of the prior


def solve(
    views: Sequence[View], start: RigState, weights: Float64 | None = None
) -> tuple[RigState, Information]:
    """Minimise the sum of squared pixel errors, each view weighted by ``weights`` (V,); None = 1.

    At ``start`` every point has to be in front of every camera.
    """
    w = np.ones(len(views)) if weights is None else weights
    corners = _gather(views)
    if not np.isfinite(_cost(corners, start, w)):
        raise CalibrationError("no initial guess puts the board in front of the cameras")
    problem = Problem(
        cost=lambda state: _cost(corners, state, w),
        linearise=lambda state: _linearise(corners, state),
        step=lambda state, normals, damping: _step(normals, state, w, damping),
    )
    state = minimise(problem, start, rounds=_ROUNDS, min_gain=_STILL)
    matrices, vectors, _ = _without_poses(_linearise(corners, state))
    return state, Information(matrices, vectors, _prior(state)[1])


def squared_errors(views: Sequence[View], state: RigState) -> tuple[Float64, Float64]:
    """Return sums of squared errors, px² (NaN = behind), and numbers of corners: (V, cameras)."""
    corners = _gather(views)
    squares = zip(corners, _squares(corners, state), strict=True)
    sums = [np.bincount(seen.view, each, len(views)) for seen, each in squares]
    counts = [np.bincount(seen.view, minlength=len(views)) for seen in corners]
    return np.stack(sums, axis=1), np.stack(counts, axis=1).astype(np.float64)


def moved(state: RigState, step: Float64) -> RigState:
    """Return the state with ``step`` (P,) added to its shared parameters; board poses stay."""
    cameras, at = [], 0
    for camera in state.cameras:
        matrix, end = np.array(camera.matrix), at + 4 + camera.distortion.size
        matrix[[0, 1, 0, 1], [0, 1, 2, 2]] += step[at : at + 4]
        distortion = camera.distortion + step[at + 4 : end]
        cameras.append(replace(camera, matrix=matrix, distortion=distortion))
        at = end
    T = state.T_camera_rig
    if len(cameras) > 1:
        T = (T[0], _moved_pose(T[1], step[at : at + _POSE]))
    return replace(state, cameras=tuple(cameras), T_camera_rig=T)


def _moved_pose(T: Float64, step: Float64) -> Float64:
    return orthonormalise(make_transform(exp_so3(step[:3]), step[3:]) @ T)


def _gather(views: Sequence[View]) -> list[_Corners]:
    corners = []
    for sightings in zip(*(view.seen for view in views), strict=True):
        board_m = np.concatenate([seen.board_m for seen in sightings])
        pixels = np.concatenate([seen.pixels for seen in sightings])
        counts = [len(seen.pixels) for seen in sightings]
        corners.append(_Corners(board_m, pixels, np.repeat(np.arange(len(views)), counts)))
    return corners


def _linearise(corners: Sequence[_Corners], state: RigState) -> Float64:
    """Return JᵀJ of each view, (V, P + 7, P + 7): shared parameters, pose of the board, error."""
    size, at = len(_prior(state)[0]), 0
    normals = np.zeros((len(state.T_rig_board), size + _POSE + 1, size + _POSE + 1))
    for camera, T, seen in zip(state.cameras, state.T_camera_rig, corners, strict=True):
        xyz_rig = seen.in_rig(state)
        xyz = apply(T, xyz_rig)
        pixels, by_point, by_lens = project_with_jacobian(camera, xyz)
        J = np.zeros((len(xyz), 2, size + _POSE + 1))
        J[:, :, at : at + by_lens.shape[2]] = by_lens
        if at:
            J[:, :, size - _POSE : size] = by_point @ _by_motion(xyz)
        J[:, :, size:-1] = by_point @ T[:3, :3] @ _by_motion(xyz_rig)
        J[:, :, -1] = seen.pixels - pixels
        at += by_lens.shape[2]
        ends = np.searchsorted(seen.view, np.arange(1, len(normals)))
        for number, each in enumerate(np.split(J, ends)):
            rows = each.reshape(-1, J.shape[2])
            normals[number] += rows.T @ rows
    return normals


def _by_motion(xyz: Float64) -> Float64:
    """Return float64 (N, 3, 6), Jacobian of points for a small rotation and translation."""
    return np.roll(step_jacobian(xyz), 3, axis=2)


def _prior(state: RigState) -> tuple[Float64, Float64]:
    """Return what a prior keeps near zero, lenses of rational models: (P,), information (P, P)."""
    numbers, information = [], []
    for camera in state.cameras:
        kept = (_PRIOR_PX / _PRIOR_SPREAD) ** 2 if camera.distortion.size >= 8 else 0.0
        numbers += [np.zeros(4), camera.distortion]
        information += [np.zeros(4), np.full(camera.distortion.size, kept)]
    pose = np.zeros(_POSE * (len(state.cameras) - 1))
    return np.concatenate([*numbers, pose]), np.diag(np.concatenate([*information, pose]))


def _squares(corners: Sequence[_Corners], state: RigState) -> list[Float64]:
    """Return float64 (N,) of each camera, squared distances in the image, pixels²."""
    return [
        ((seen.pixels - project_raw(camera, apply(T, seen.in_rig(state)))) ** 2).sum(axis=1)
        for camera, T, seen in zip(state.cameras, state.T_camera_rig, corners, strict=True)
    ]


def _cost(corners: Sequence[_Corners], state: RigState, weights: Float64) -> float:
    """Return the sum of squared errors and of the prior; NaN for a point behind a camera."""
    numbers, prior = _prior(state)
    squares = zip(corners, _squares(corners, state), strict=True)
    total = sum(float(weights[seen.view] @ each) for seen, each in squares)
    return total + float(numbers @ prior @ numbers)


def _without_poses(normals: Float64, damping: float = 0.0) -> tuple[Float64, Float64, Float64]:
    """Eliminate the pose of the board from the normal equations of each view.

    Returns matrices (V, P, P) and vectors (V, P) of the shared parameters, and (V, 6, P + 1): the
    step of the pose is the last column less the others times that of the shared parameters.
    """
    P = normals.shape[1] - _POSE - 1
    shared, own = normals[:, :P], normals[:, P:-1]
    damped = own[:, :, P:-1] * (1.0 + damping * np.eye(_POSE))
    back = np.linalg.solve(damped, np.delete(own, np.s_[P:-1], axis=2))
    left = np.delete(shared, np.s_[P:-1], axis=2) - shared[:, :, P:-1] @ back
    return left[:, :, :-1], left[:, :, -1], np.asarray(back, dtype=np.float64)


def _step(normals: Float64, state: RigState, weights: Float64, damping: float) -> RigState | None:
    """Return the state after one damped step; None if a focal length would not be positive."""
    numbers, prior = _prior(state)
    matrices, vectors, back = _without_poses(normals, damping)
    A = prior + np.tensordot(weights, matrices, axes=1)
    A[np.diag_indices_from(A)] += damping * np.diag(A) + 1e-15
    step = solve_scaled(A, weights @ vectors - prior @ numbers)
    own = back[:, :, -1] - back[:, :, :-1] @ step
    poses = np.stack(list(map(_moved_pose, state.T_rig_board, own)))
    try:
        return replace(moved(state, step), T_rig_board=poses)
    except CalibrationError:
        return None


def solve_scaled(A: Float64, a: Float64) -> Float64:
    """Solve symmetric equations of unknowns of any size; undetermined directions stay at 0."""
    scale = 1.0 / np.sqrt(np.maximum(np.diag(A), 1e-300))
    solution, *_ = np.linalg.lstsq(A * np.outer(scale, scale), a * scale, rcond=1e-14)
    return np.asarray(solution * scale)
