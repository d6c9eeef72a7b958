"""Least squares: alignment of points and trajectories, and the loop of non-linear fits."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import Any, Final, Generic, TypeVar

import numpy as np
from numpy.typing import NDArray

from recon.core.geometry.se3 import apply, exp_so3, log_so3, make_transform
from recon.core.values import Trajectory
from recon.core.values.arrays import Bool, Float64, Int32, freeze

_AXIS_M: Final = 20.0  # typical distance of a map from its cameras
# Short beside a path, whose tilt is to count, and longer than a straight one is wide.
_UP_M: Final = np.array([0.0, 0.0, 3.0])
_IN_ONE_PLACE: Final = 1e-12
_ENDS: Final = 24  # points between which lines are tried: of 276, some have two good ends
_SIGMA_OF_MEDIAN: Final = 1.4826
_SIGMAS: Final = 4.0  # hardly one of ten thousand normal errors is larger


@dataclass(frozen=True, eq=False)
class Similarity:
    """A scaling, then a rigid transform (4, 4): ``to = T_to_from · (scale · from)``."""

    T_to_from: Float64
    scale: float = 1.0

    def __post_init__(self) -> None:
        freeze(self, "T_to_from", np.float64, (4, 4))

    def move(self, trajectory: Trajectory) -> Trajectory:
        poses = trajectory.T_world_camera.copy()
        poses[:, :3, 3] *= self.scale
        return Trajectory(self.T_to_from @ poses, trajectory.timestamps_s)


def fit_points(from_m: Float64, to_m: Float64, *, scaled: bool = False) -> Similarity:
    """Return the least-squares similarity between corresponding points, float64 (N, 3), N ≥ 1.

    A rotation that the points do not determine, such as that about a straight line, is left as
    small as the others allow. The scale is 1 unless ``scaled``, and where all points coincide.

    Ref: S. Umeyama, "Least-squares estimation of transformation parameters between two point
    patterns", PAMI 13(4), 1991, equations 40 to 42.
    """
    from_mean, to_mean = from_m.mean(axis=0), to_m.mean(axis=0)
    centred = from_m - from_mean
    U, strength, Vt = np.linalg.svd((to_m - to_mean).T @ centred / len(from_m))
    signs = np.array([1.0, 1.0, np.sign(np.linalg.det(U @ Vt))])
    rotation = (U * signs) @ Vt
    variance = float(np.mean(np.sum(centred**2, axis=1)))
    possible = scaled and variance > _IN_ONE_PLACE
    scale = float(strength @ signs) / variance if possible else 1.0
    return Similarity(make_transform(rotation, to_mean - scale * rotation @ from_mean), scale)


def fit_upright(from_m: Float64, to_m: Float64) -> Similarity:
    """Return the least-squares rigid transform between points (N, 3) of frames whose z is up."""
    return fit_points(np.vstack([from_m, from_m + _UP_M]), np.vstack([to_m, to_m + _UP_M]))


def find_agreeing(from_m: Float64, to_m: Float64, allowed_m: float) -> Bool:
    """Return bool (N,): which points fit the transform (`fit_upright`) that suits half of them.

    Transforms of two points far apart are tried. A distance of ``allowed_m``, or of four standard
    deviations, is no contradiction. Three points or fewer cannot outvote one another: all True.

    Ref: P. J. Rousseeuw, "Least median of squares regression", JASA 79, 1984.
    """
    if len(from_m) <= 3:
        return np.ones(len(from_m), np.bool_)
    ends = np.unique(np.linspace(0, len(from_m) - 1, _ENDS).round().astype(int))
    first, second = ends[np.stack(np.triu_indices(len(ends), 1))]
    apart_m = np.linalg.norm(from_m[first] - from_m[second], axis=1)
    far = apart_m >= 0.5 * apart_m.max()
    pairs = np.stack([first[far], second[far]], axis=1)
    tried = [_distances_m(from_m, to_m, pair) for pair in pairs]
    best_m = min(tried, key=lambda distances_m: float(np.median(distances_m)))
    for _ in range(2):  # two points alone carry their own errors
        limit_m = max(allowed_m, _SIGMAS * _SIGMA_OF_MEDIAN * float(np.median(best_m)))
        agree = best_m <= limit_m
        best_m = _distances_m(from_m, to_m, agree)
    return np.asarray(agree)


def _distances_m(from_m: Float64, to_m: Float64, chosen: NDArray[Any]) -> Float64:
    """Return how far each point is from its partner by the transform of the chosen ones."""
    T_to_from = fit_upright(from_m[chosen], to_m[chosen]).T_to_from
    return np.asarray(np.linalg.norm(apply(T_to_from, from_m) - to_m, axis=1))


def turn_covariance(points_m: Float64, sigma_m: Float64, level_rad: float) -> Float64:
    """Return the covariance (3, 3), rad², of the rotation that points (N, 3) of a frame fix.

    ``sigma_m`` (N,) are errors of their coordinates, ``level_rad`` that of the frame's z being up.
    What they do not fix at all has a variance of 1e12.
    """
    weights = sigma_m**-2.0
    arms_m = points_m - np.average(points_m, axis=0, weights=weights)
    spread = np.einsum("n,ni,nj->ij", weights, arms_m, arms_m)
    level = np.diag([1.0, 1.0, 0.0]) / level_rad**2
    return np.linalg.inv(np.trace(spread) * np.eye(3) - spread + level + 1e-12 * np.eye(3))


def fit_paths(from_path: Trajectory, to_path: Trajectory) -> Similarity:
    """Return the rigid transform between trajectories that fits centres and axes of their poses."""
    return fit_points(_axes_m(from_path), _axes_m(to_path))


def _axes_m(path: Trajectory) -> Float64:
    poses = path.T_world_camera
    tips = np.swapaxes(poses[:, :3, :3], 1, 2) * _AXIS_M + poses[:, None, :3, 3]
    return np.concatenate([poses[:, None, :3, 3], tips], axis=1).reshape(-1, 3)


def interpolate_poses(trajectory: Trajectory, stamps_s: Float64) -> Float64:
    """Return poses (N, 4, 4) at given times; outside of the trajectory, its first or last pose."""
    times = trajectory.timestamps_s
    after = np.clip(np.searchsorted(times, stamps_s), 1, max(1, len(times) - 1))
    after = np.minimum(after, len(times) - 1)
    before = np.maximum(after - 1, 0)
    span = np.where(times[after] > times[before], times[after] - times[before], 1.0)
    ratios = np.clip((stamps_s - times[before]) / span, 0.0, 1.0)
    poses = trajectory.T_world_camera
    steps = zip(before, after, ratios, strict=True)
    return np.stack([pose_between(poses[i], poses[j], float(ratio)) for i, j, ratio in steps])


def pose_between(first: Float64, second: Float64, ratio: float) -> Float64:
    """Return the pose (4, 4) at a fraction (0 to 1) of the way from one pose to another."""
    turn = log_so3(first[:3, :3].T @ second[:3, :3])
    position = (1 - ratio) * first[:3, 3] + ratio * second[:3, 3]
    return make_transform(first[:3, :3] @ exp_so3(ratio * turn), position)


def nearest_sorted(numbers: NDArray[Any], others: NDArray[Any]) -> Int32:
    """Return int32 (N,), the index of the nearest of sorted others (M ≥ 1); of two, the first."""
    after = np.clip(np.searchsorted(others, numbers), 0, len(others) - 1)
    before = np.maximum(after - 1, 0)
    earlier = np.abs(numbers - others[before]) <= np.abs(others[after] - numbers)
    return np.where(earlier, before, after).astype(np.int32)


State = TypeVar("State")
Linear = TypeVar("Linear")

_MORE, _LESS = 10.0, 0.1  # factors of the damping after a step that fails or succeeds
_LEAST_DAMPING, _LARGEST_DAMPING = 1e-12, 1e12


@dataclass(frozen=True)
class Problem(Generic[State, Linear]):
    """What is fitted."""

    # gives the cost of a state; NaN or infinite where it is impossible
    cost: Callable[[State], float]
    linearise: Callable[[State], Linear]  # gives the normal equations at a state
    # gives the state after a step with so much damping; None = impossible
    step: Callable[[State, Linear, float], State | None]


def minimise(
    problem: Problem[State, Linear],
    start: State,
    *,
    rounds: int,
    min_gain: float,
    damping: float = 1e-3,
) -> State:
    """Minimise a cost, finite at ``start``, by damped Gauss-Newton steps that each must lower it.

    At most ``rounds`` steps are tried; one that gains less than ``min_gain`` of it is the last.
    ``damping`` is the first, relative to the diagonal of the normal equations.
    """
    state, lowest, linear = start, problem.cost(start), problem.linearise(start)
    for _ in range(rounds):
        trial = problem.step(state, linear, damping)
        trial_cost = float("inf") if trial is None else problem.cost(trial)
        if trial is None or not trial_cost < lowest:  # also where it is NaN
            damping *= _MORE
            if damping > _LARGEST_DAMPING:
                break
            continue
        gain = (lowest - trial_cost) / lowest
        state, lowest, damping = trial, trial_cost, max(damping * _LESS, _LEAST_DAMPING)
        if gain < min_gain:
            break
        linear = problem.linearise(state)
    return state
