"""Pose graph optimisation: corrects a path so that its loops close."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from itertools import pairwise
from typing import Final

import numpy as np
from numpy.typing import NDArray

from recon.core.errors import RegistrationError
from recon.core.geometry.interpolation import pose_between
from recon.core.geometry.se3 import adjoint, as_step, invert, orthonormalise
from recon.core.values import Trajectory
from recon.core.values.arrays import Float64
from recon.places.drift import Drift, DriftModel, drift_over
from recon.places.pose_graph import PoseEdge, optimise_poses
from recon.places.verify import Loop

_EASING: Final = 10.0  # factor by which the tolerance of loops falls from round to round
_KEPT: Final = 0.25  # least weight of a loop that is believed


_NODE_M: Final = 5.0
"""Path between two nodes of the graph."""

_MAX_NODES: Final = 400
"""Longer drives get nodes farther apart: time is cubic."""

_LOOP_SIGMA_M: Final = 0.05
"""Standard deviation of a loop that more matches do not improve."""

_LOOP_SHARE: Final = 0.03
"""Standard deviation that is added per distance between its two frames: features that moved farther
match worse, and not evenly."""

_LOOP_SIGMA_DEG: Final = 0.1
"""As the first, of its rotation."""

_MAX_CHI2: Final = 22.5
"""Chi-square at which the weight of a loop is a quarter: 0.1 % of right ones are beyond."""

_MAX_BEND_CHI2: Final = 6.0
"""Mean chi-square of the odometry edges above which no loop is believed."""


@dataclass(frozen=True, eq=False)
class Closure:
    """A path after loop closure.

    Attributes:
        trajectory: The corrected path; the same object where no loop is closed.
        closed: The loops that are closed.
        refused: The loops that the rest of the graph contradicts.
    """

    trajectory: Trajectory
    closed: tuple[Loop, ...]
    refused: tuple[Loop, ...]

    def correction(self, odometry: Trajectory, frame: int) -> Float64:
        """``T_corrected_world`` (4, 4) for what was mapped at a frame with the odometry's pose."""
        T_new, T_old = (path.T_world_camera[frame] for path in (self.trajectory, odometry))
        return orthonormalise(T_new @ invert(T_old))


def close_loops(
    trajectory: Trajectory, path_m: Float64, loops: Sequence[Loop], drift: DriftModel
) -> Closure:
    """Correct a path so that its loops close.

    Nodes are spaced along the path; odometry edges link each to the next, loop edges link distant
    ones. The optimiser may switch loops off. It starts with a tolerance that admits every loop and
    tightens it step by step, so that a right loop is not refused because of the very drift that it
    corrects. If the loops deform the odometry more than its drift explains, none is believed.

    Args:
        trajectory: By odometry.
        path_m: float64 (N,), path up to each frame, by `path_lengths`.
        loops: Loops between frames of it.
        drift: How far odometry may drift.

    Ref:
        Yang et al., "Graduated non-convexity for robust spatial perception", RA-L 2020.
    """
    if not loops:
        return Closure(trajectory, (), ())
    nodes = _nodes(path_m)
    steps = _odometry_edges(trajectory, path_m, nodes, drift)
    ties = [_loop_edge(loop, trajectory, path_m, nodes, drift) for loop in loops]
    try:
        poses, weights = _solve(trajectory.T_world_camera[nodes], steps, ties)
    except RegistrationError:  # a map by odometry alone is better than none
        return Closure(trajectory, (), tuple(loops))
    bend_chi2 = float(np.mean([misfit(edge, poses) for edge in steps]))
    kept = weights >= _KEPT
    if bend_chi2 > _MAX_BEND_CHI2 or not kept.any():
        return Closure(trajectory, (), tuple(loops))
    return Closure(
        _bent(trajectory, path_m, nodes, poses),
        tuple(loop for loop, keep in zip(loops, kept, strict=True) if keep),
        tuple(loop for loop, keep in zip(loops, kept, strict=True) if not keep),
    )


def loop_bias(loop: Loop) -> Drift:
    """Return the standard deviations of a loop that more matches do not improve."""
    apart_m = float(np.linalg.norm(loop.T_first_last[:3, 3]))
    position_m = math.hypot(_LOOP_SIGMA_M, _LOOP_SHARE * apart_m)
    return Drift(position_m, math.radians(_LOOP_SIGMA_DEG))


def misfit(edge: PoseEdge, T_world_node: Float64) -> float:
    """Return chi-square of an edge."""
    T = invert(T_world_node[edge.first]) @ T_world_node[edge.last]
    off = invert(edge.T_first_last) @ T
    step = as_step(off)
    return float(step @ edge.information @ step)


def _nodes(path_m: Float64) -> NDArray[np.intp]:
    """Return frames at even distances along the path, including the first and the last."""
    length = float(path_m[-1])
    count = min(_MAX_NODES, max(2, math.ceil(length / _NODE_M) + 1))
    marks = np.searchsorted(path_m, np.linspace(0.0, length, count))
    return np.unique(np.concatenate([[0], marks, [len(path_m) - 1]]))


def _solve(start: Float64, steps: list[PoseEdge], ties: list[PoseEdge]) -> tuple[Float64, Float64]:
    """Return poses of the nodes, and the weights of the loops."""
    poses = start
    worst = max(misfit(edge, poses) for edge in ties)
    rounds = math.ceil(math.log(max(worst / _MAX_CHI2, 1.0), _EASING))
    for k in range(rounds, -1, -1):
        tolerance = _MAX_CHI2 * _EASING**k
        poses, weights = optimise_poses(poses, [*steps, *ties], tolerance)
    return poses, weights[len(steps) :]


def _odometry_edges(
    trajectory: Trajectory, path_m: Float64, nodes: NDArray[np.intp], model: DriftModel
) -> list[PoseEdge]:
    poses = trajectory.T_world_camera
    edges = []
    for k, (first, last) in enumerate(pairwise(nodes)):
        # Where the camera stands still, 0.1 m keeps the information finite.
        drift = drift_over(max(float(path_m[last] - path_m[first]), 0.1), model)
        T = invert(poses[first]) @ poses[last]
        edges.append(PoseEdge(k, k + 1, T, _inverse(drift.covariance)))
    return edges


def _loop_edge(
    loop: Loop,
    trajectory: Trajectory,
    path_m: Float64,
    nodes: NDArray[np.intp],
    model: DriftModel,
) -> PoseEdge:
    """Return the loop as an edge between the nodes nearest to its frames."""
    poses = trajectory.T_world_camera
    first, last = (_nearest_node(path_m, nodes, frame) for frame in (loop.first, loop.last))
    to_first = invert(poses[nodes[first]]) @ poses[loop.first]
    to_last = invert(poses[loop.last]) @ poses[nodes[last]]
    way_m = abs(float(path_m[nodes[first]] - path_m[loop.first]))
    way_m += abs(float(path_m[nodes[last]] - path_m[loop.last]))
    drift, bias = drift_over(way_m, model), loop_bias(loop)
    other = Drift(
        math.hypot(drift.position_m, bias.position_m),
        math.hypot(drift.angle_rad, bias.angle_rad),
    )
    covariance = np.linalg.inv(_turned(loop.information, to_last)) + other.covariance
    T = orthonormalise(to_first @ loop.T_first_last @ to_last)
    return PoseEdge(first, last, T, _inverse(covariance), doubtful=True)


def _nearest_node(path_m: Float64, nodes: NDArray[np.intp], frame: int) -> int:
    return int(np.argmin(np.abs(path_m[nodes] - path_m[frame])))


def _inverse(covariance: Float64) -> Float64:
    """Return the information (6, 6) of a covariance (6, 6)."""
    return np.asarray(np.linalg.inv(covariance), np.float64)


def _turned(information: Float64, T_frame_node: Float64) -> Float64:
    """Return the information of a step in a node's axes, from that in a frame's axes near it."""
    turn = adjoint(T_frame_node)
    turned: Float64 = turn.T @ information @ turn
    return turned


def _bent(
    trajectory: Trajectory, path_m: Float64, nodes: NDArray[np.intp], T_world_node: Float64
) -> Trajectory:
    """Return every pose moved with the nodes before and after it, interpolated by distance."""
    old = trajectory.T_world_camera
    before = np.clip(np.searchsorted(nodes, np.arange(len(old)), side="right") - 1, 0, None)
    before = np.minimum(before, len(nodes) - 2)
    new = np.empty_like(old)
    for frame, k in enumerate(before):
        a, b = nodes[k], nodes[k + 1]
        from_a = T_world_node[k] @ invert(old[a]) @ old[frame]
        from_b = T_world_node[k + 1] @ invert(old[b]) @ old[frame]
        span = float(path_m[b] - path_m[a])
        share = float(path_m[frame] - path_m[a]) / span if span > 0 else 0.0
        new[frame] = orthonormalise(pose_between(from_a, from_b, share))
    new[0] = old[0]
    return Trajectory(new, trajectory.timestamps_s)
