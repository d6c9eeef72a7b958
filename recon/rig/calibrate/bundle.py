"""Bundle adjustment of the lenses, the pose of the right camera and every pose of the board.

One solver handles one or two cameras, pinhole and fisheye lenses, and partly visible boards. The
board poses are eliminated view by view (Schur complement), which leaves the few parameters shared
by all views and each view's information matrix for them. The bootstrap over views reweights these
matrices.

Ref: Triggs et al. 2000, "Bundle adjustment: a modern synthesis", section 6; Zhang 2000.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Final

import numpy as np

from recon.core.errors import CalibrationError
from recon.core.geometry.se3 import apply, exp_so3, make_transform, orthonormalise, step_jacobian
from recon.core.least_squares import Problem, minimise
from recon.core.values import CameraIntrinsics
from recon.core.values.arrays import Float64, Int32
from recon.stereo.rectify.lens import project, project_with_jacobian

_ROUNDS: Final = 100
# Relative decrease of the cost at which the solver has converged.
_STILL: Final = 1e-12
# The eight coefficients of a rational lens are not all observable: each has a zero-mean prior of
# this standard deviation, against corners measured to 0.1 px.
_PRIOR_SPREAD: Final = 2.0
_PRIOR_PX: Final = 0.1
_POSE: Final = 6


@dataclass(frozen=True, eq=False)
class Sighting:
    """Board corners that one camera saw in one view.

    Attributes:
        numbers: int32 (N,), indices of the corners on the board.
        board_m: float64 (N, 3), their positions on the board.
        pixels: float64 (N, 2), their positions in the image.
    """

    numbers: Int32
    board_m: Float64
    pixels: Float64


@dataclass(frozen=True, eq=False)
class View:
    """One pose of the board, seen by every camera.

    Attributes:
        name: Name shown to the user.
        seen: One sighting for each camera.
    """

    name: str
    seen: tuple[Sighting, ...]


@dataclass(frozen=True, eq=False)
class RigState:
    """Everything that is estimated.

    Attributes:
        cameras: One or two cameras.
        T_camera_rig: float64 (4, 4) for each; the first is the identity.
        T_rig_board: float64 (4, 4) for each view.
    """

    cameras: tuple[CameraIntrinsics, ...]
    T_camera_rig: tuple[Float64, ...]
    T_rig_board: tuple[Float64, ...]

    def residuals(self, view: View, number: int) -> tuple[Float64, ...]:
        """Return float64 (N, 2) for each camera: observed minus predicted, pixels."""
        return tuple(
            seen.pixels - project(camera, apply(T @ self.T_rig_board[number], seen.board_m))
            for camera, T, seen in zip(self.cameras, self.T_camera_rig, view.seen, strict=True)
        )


@dataclass(frozen=True, eq=False)
class Information:
    """Information of each view about the shared parameters, at the solution.

    The shared parameters are (fx, fy, cx, cy, distortion …) of each camera in turn, followed, with
    two cameras, by the pose of the right camera: six parameters (rotation, translation) of a small
    motion applied after it.

    Attributes:
        matrices: float64 (V, P, P), information matrix of each view, board poses eliminated.
        vectors: float64 (V, P), gradient of each view; their weighted sum is zero.
        prior: float64 (P, P), information matrix of the prior.
        weights: float64 (V,), weights of the views.
    """

    matrices: Float64
    vectors: Float64
    prior: Float64
    weights: Float64


@dataclass(frozen=True, eq=False)
class _Blocks:
    """Normal equations of one view: shared (A, a), mixed (B), board pose (C, c)."""

    A: Float64
    B: Float64
    C: Float64
    a: Float64
    c: Float64


def solve(
    views: Sequence[View], start: RigState, weights: Float64 | None = None
) -> tuple[RigState, Information]:
    """Minimise the sum of squared pixel errors (Levenberg-Marquardt).

    Args:
        views: The views.
        start: Initial guess, with every point in front of every camera.
        weights: float64 (V,), weight of each view's squared errors; None = 1.

    Raises:
        CalibrationError: The initial guess has points behind a camera.
    """
    w = np.ones(len(views)) if weights is None else weights
    if not np.isfinite(_cost(views, start, w)):
        raise CalibrationError("no initial guess puts the board in front of the cameras")
    state = minimise(
        Problem(
            cost=lambda state: _cost(views, state, w),
            linearise=lambda state: _linearise(views, state),
            step=lambda state, blocks, damping: _step(blocks, state, w, damping),
        ),
        start,
        rounds=_ROUNDS,
        min_gain=_STILL,
    )
    return state, _information(_linearise(views, state), state, w)


def shared_size(state: RigState) -> int:
    """Return the number of shared parameters, P."""
    return sum(_camera_size(camera) for camera in state.cameras) + _POSE * (len(state.cameras) - 1)


def moved(state: RigState, step: Float64) -> RigState:
    """Return the state with ``step`` (P,) added to its shared parameters; board poses stay.

    Raises:
        CalibrationError: A focal length would not be positive.
    """
    cameras, at = [], 0
    for camera in state.cameras:
        size = _camera_size(camera)
        cameras.append(_moved_camera(camera, step[at : at + size]))
        at += size
    T = state.T_camera_rig
    if len(cameras) > 1:
        T = (T[0], _moved_pose(T[1], step[at : at + _POSE]))
    return replace(state, cameras=tuple(cameras), T_camera_rig=T)


def _camera_size(camera: CameraIntrinsics) -> int:
    return 4 + camera.distortion.size


def _moved_camera(camera: CameraIntrinsics, step: Float64) -> CameraIntrinsics:
    matrix = np.array(camera.matrix)
    matrix[[0, 1, 0, 1], [0, 1, 2, 2]] += step[:4]
    return replace(camera, matrix=matrix, distortion=camera.distortion + step[4:])


def _moved_pose(T: Float64, step: Float64) -> Float64:
    return orthonormalise(make_transform(exp_so3(step[:3]), step[3:]) @ T)


def _linearise(views: Sequence[View], state: RigState) -> list[_Blocks]:
    return [_view_blocks(view, state, number) for number, view in enumerate(views)]


def _view_blocks(view: View, state: RigState, number: int) -> _Blocks:
    """Return the normal equations of one view."""
    size, at = shared_size(state), 0
    J_shared, J_own, errors = [], [], []
    xyz_rig_of = state.T_rig_board[number]
    for camera, T, seen in zip(state.cameras, state.T_camera_rig, view.seen, strict=True):
        xyz_rig = apply(xyz_rig_of, seen.board_m)
        xyz = apply(T, xyz_rig)
        pixels, by_point, by_lens = project_with_jacobian(camera, xyz)
        count = 2 * len(xyz)
        shared = np.zeros((count, size))
        shared[:, at : at + _camera_size(camera)] = by_lens.reshape(count, -1)
        if at:
            shared[:, -_POSE:] = (by_point @ _by_motion(xyz)).reshape(count, _POSE)
        J_shared.append(shared)
        J_own.append((by_point @ T[:3, :3] @ _by_motion(xyz_rig)).reshape(count, _POSE))
        errors.append((seen.pixels - pixels).ravel())
        at += _camera_size(camera)
    S, P, r = np.concatenate(J_shared), np.concatenate(J_own), np.concatenate(errors)
    return _Blocks(S.T @ S, S.T @ P, P.T @ P, S.T @ r, P.T @ r)


def _by_motion(xyz: Float64) -> Float64:
    """Return float64 (N, 3, 6), Jacobian of points for a small rotation and translation."""
    return np.roll(step_jacobian(xyz), 3, axis=2)


def _prior(state: RigState) -> Float64:
    """Return float64 (P, P), information that keeps coefficients of rational lenses near zero."""
    diagonal, at = np.zeros(shared_size(state)), 0
    for camera in state.cameras:
        if camera.distortion.size >= 8:
            diagonal[at + 4 : at + _camera_size(camera)] = (_PRIOR_PX / _PRIOR_SPREAD) ** 2
        at += _camera_size(camera)
    return np.diag(diagonal)


def _shared_numbers(state: RigState) -> Float64:
    """Return float64 (P,), the distortion at its place; 0 elsewhere, where the prior is zero."""
    numbers = [np.concatenate([np.zeros(4), camera.distortion]) for camera in state.cameras]
    return np.concatenate([*numbers, np.zeros(_POSE * (len(state.cameras) - 1))])


def _cost(views: Sequence[View], state: RigState, weights: Float64) -> float:
    """Return the sum of squared errors and of the prior; NaN for a point behind a camera."""
    numbers = _shared_numbers(state)
    total = float(numbers @ _prior(state) @ numbers)
    for number, (view, w) in enumerate(zip(views, weights, strict=True)):
        total += w * sum(float((error**2).sum()) for error in state.residuals(view, number))
    return total


def _step(
    blocks: Sequence[_Blocks], state: RigState, weights: Float64, damping: float
) -> RigState | None:
    """Return the state after one damped step; None if a focal length would not be positive."""
    prior = _prior(state)
    A, a = prior.copy(), -prior @ _shared_numbers(state)
    own = []
    for w, block in zip(weights, blocks, strict=True):
        damped = block.C + damping * np.diag(np.diag(block.C))
        back = np.linalg.solve(damped, np.column_stack([block.B.T, block.c]))
        A += w * (block.A - block.B @ back[:, :-1])
        a += w * (block.a - block.B @ back[:, -1])
        own.append(back)
    A[np.diag_indices_from(A)] += damping * np.diag(A) + 1e-15
    step = solve_scaled(A, a)
    poses = tuple(
        _moved_pose(T, back[:, -1] - back[:, :-1] @ step)
        for T, back in zip(state.T_rig_board, own, strict=True)
    )
    try:
        return replace(moved(state, step), T_rig_board=poses)
    except CalibrationError:
        return None


def solve_scaled(A: Float64, a: Float64) -> Float64:
    """Solve symmetric equations whose unknowns differ by orders of magnitude.

    Directions that are not determined stay at 0.
    """
    scale = 1.0 / np.sqrt(np.maximum(np.diag(A), 1e-300))
    solution, *_ = np.linalg.lstsq(A * np.outer(scale, scale), a * scale, rcond=1e-14)
    return np.asarray(solution * scale)


def _information(blocks: Sequence[_Blocks], state: RigState, weights: Float64) -> Information:
    matrices, vectors = [], []
    for block in blocks:
        back = np.linalg.solve(block.C, np.column_stack([block.B.T, block.c]))
        matrices.append(block.A - block.B @ back[:, :-1])
        vectors.append(block.a - block.B @ back[:, -1])
    return Information(np.array(matrices), np.array(vectors), _prior(state), weights)
