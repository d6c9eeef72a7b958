"""Paths corrected so that their loops close, by pose graph optimisation."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import astuple, dataclass, replace
from itertools import pairwise
from typing import Final

import numpy as np
from numpy.typing import NDArray

from recon.core.errors import RegistrationError
from recon.core.geometry.alignment import pose_between
from recon.core.geometry.se3 import adjoint, as_step, invert, orthonormalise
from recon.core.values import Trajectory
from recon.core.values.arrays import Bool, Float64
from recon.odometry.health import segment_numbers, trusted_poses
from recon.odometry.protocol import OdometryHealth
from recon.places.places import MIN_AGREEING, Drift, Loop, drift_over, path_lengths
from recon.places.pose_graph import Held, PoseEdge, optimise_poses

_EASING: Final = 10.0  # factor by which the tolerance of loops falls from round to round
_KEPT: Final = 0.25  # least weight of a loop that is believed
# Lengths are those on a road: they are times the scale of the scene.
_NODE_M: Final = 5.0  # path between two nodes of the graph
_MAX_NODES: Final = 4000  # longer drives get nodes farther apart; so many take some seconds
_LOOP_SIGMA_M: Final = 0.05  # standard deviation of a loop that more matches do not improve
_LOOP_RATIO: Final = 0.03
"""Standard deviation that is added per distance between its two frames: features that moved farther
match worse, and not evenly."""

_LOOP_SIGMA_DEG: Final = 0.1  # as the first, of its rotation
_MAX_CHI2: Final = 22.5
"""Chi-square at which the weight of a loop is a quarter: 0.1 % of right ones are beyond."""

_MAX_DEFORMATION_CHI2: Final = (
    6.0  # mean chi-square of the odometry edges above which no loop is believed
)
USUAL: Final = 0.3
"""What odometry usually drifts, as a fraction of what it may: measured positions, whose errors do
not grow, would make a path as rough as they are if it counted for less."""

_HELD_ROUNDS: Final = 2
"""Solutions of a graph with measured positions; the second knows how antennas are turned."""


@dataclass(frozen=True, eq=False)
class Closure:
    """A path after loop closure."""

    trajectory: Trajectory  # the corrected path; the same object where no loop is closed
    closed: tuple[Loop, ...]  # the loops that are closed
    refused: tuple[Loop, ...]  # the loops that the rest of the graph contradicts

    def correction(self, odometry: Trajectory, frame: int) -> Float64:
        """Return ``T_corrected_world`` (4, 4) for what was mapped at a frame by odometry."""
        T_new, T_old = (path.T_world_camera[frame] for path in (self.trajectory, odometry))
        return orthonormalise(T_new @ invert(T_old))


@dataclass(frozen=True, eq=False)
class DrivePath:
    """The path of a drive in the graph."""

    trajectory: Trajectory  # by odometry; about where it lies beside the other drives
    # float64 (N,), path up to each frame, by `path_lengths`; 0 everywhere where poses are known,
    # which moves the drive as one rigid thing
    path_m: Float64
    # int64 (N,), the segment of each frame (`recon.odometry.health.segment_numbers`): odometry says
    # nothing of what lies between two of them, or of a frame of segment -1
    segment: NDArray[np.int64]
    # float64 (N, 2), summed variances of the motions up to each frame, as odometry states them:
    # of positions (m²) and of rotations (rad²)
    variance: Float64
    scale: float = 1.0  # of the scene, against a road

    @staticmethod
    def of(odometry: Trajectory, health: Sequence[OdometryHealth], scale: float = 1.0) -> DrivePath:
        """Return the path of a drive by odometry, or of known poses."""
        path_m = path_lengths(odometry.T_world_camera, trusted_poses(health), scale)
        if all(record.known for record in health):
            path_m = np.zeros(len(health))
        sigma = np.array([(record.sigma_m, np.deg2rad(record.sigma_deg)) for record in health])
        variance = np.cumsum(np.nan_to_num(sigma, posinf=0.0) ** 2, axis=0)
        return DrivePath(odometry, path_m, segment_numbers(health), variance, scale)


@dataclass(frozen=True, eq=False)
class Constraint:
    """A place that two drives saw, or one drive twice."""

    drives: tuple[int, int]  # numbers of the drives of the loop's first and last frame
    loop: Loop  # the motion between the two frames, each counted in its own drive


@dataclass(frozen=True, eq=False)
class JoinedDrives:
    """Paths after all drives were joined by their constraints."""

    trajectories: tuple[Trajectory, ...]  # one for each drive, in the world of the first
    kept: Bool  # (T,), constraints that the rest of the graph does not contradict


def close_loops(path: DrivePath, loops: Sequence[Loop]) -> Closure:
    """Correct a path by odometry so that its loops close, by `join_drives`."""
    joined = join_drives([path], [Constraint((0, 0), loop) for loop in loops]) if loops else None
    if joined is None:  # a map by odometry alone is better than none
        return Closure(path.trajectory, (), tuple(loops))
    believed = _believed(loops, joined.kept, path.segment)
    closed, refused = (
        tuple(loop for loop, kept in zip(loops, believed, strict=True) if kept == side)
        for side in (True, False)
    )
    if (joined.kept & ~believed).any():  # what is not believed must not deform the path
        again = close_loops(path, closed)
        return replace(again, refused=(*again.refused, *refused))
    return Closure(joined.trajectories[0], closed, refused)


def _believed(loops: Sequence[Loop], kept: Bool, segment: NDArray[np.int64]) -> NDArray[np.bool_]:
    """Return bool (L,), which loops are believed: not those that alone hold two parts of a drive.

    Segments are put together where loops enough that contradict none hold them.
    """
    ends = segment[np.array([(loop.first, loop.last) for loop in loops])]
    while True:
        apart = kept & (ends[:, 0] != ends[:, 1])
        pairs, counts = np.unique(np.sort(ends[apart], axis=1), axis=0, return_counts=True)
        if counts.max(initial=0) < MIN_AGREEING:
            return np.asarray(kept & ~apart)
        one, other = pairs[counts.argmax()]
        ends[ends == other] = one


def join_drives(
    drives: Sequence[DrivePath], constraints: Sequence[Constraint], held: Held | None = None
) -> JoinedDrives | None:
    """Correct the paths of drives so that their constraints hold; None = these are not believed.

    Fixed is the first pose of the longest segment of the first drive. Nodes are spaced along the
    paths; odometry edges link each to the next of its segment, constraints link distant ones. The
    optimiser may switch constraints off. It starts with a tolerance that admits every constraint
    and tightens it step by step, so that a right one is not refused because of the very drift that
    it corrects. If they deform the odometry of a drive more than its drift explains, none is
    believed.

    Ref: Yang et al., "Graduated non-convexity for robust spatial perception", RA-L 2020.
    """
    nodes = _spaced(drives, constraints)
    begins = np.cumsum([0, *map(len, nodes)]).tolist()
    ratio = 1.0 if held is None else USUAL
    chains = [
        odometry_edges(drive, own, begin, ratio)
        for drive, own, begin in zip(drives, nodes, begins[:-1], strict=True)
    ]
    edges = [_constraint_edge(constraint, drives, nodes, begins) for constraint in constraints]
    start = [d.trajectory.T_world_camera[own] for d, own in zip(drives, nodes, strict=True)]
    # Segments are numbered so that no two drives have the same.
    parts = [
        d.segment[own] + (k << 32) for k, (d, own) in enumerate(zip(drives, nodes, strict=True))
    ]
    root = longest_segment(drives[0].segment)
    begun = _beside(np.concatenate(start), np.concatenate(parts), root, constraints, edges)
    anchor = int(np.argmax(drives[0].segment[nodes[0]] == root))
    steps = [edge for chain in chains for edge in chain]
    try:
        if held is None:
            poses, weights = _solve(begun, steps, edges, anchor)
        else:  # with the survey as one more node, which is free
            paths = [drive.trajectory for drive in drives]
            poses = np.concatenate([begun, held.T_world_survey[None]])
            for _ in range(_HELD_ROUNDS):
                fixed = held.edges(paths, nodes, poses)
                poses, weights = _solve(poses, [*steps, *fixed], edges)
            poses = poses[:-1]
    except RegistrationError:
        return None
    deformations = [np.mean([misfit(edge, poses) for edge in chain]) for chain in chains if chain]
    kept = weights >= _KEPT
    if ratio**2 * max(deformations, default=0.0) > _MAX_DEFORMATION_CHI2 or (
        constraints and not kept.any()
    ):
        return None
    solved = [poses[a:b] for a, b in pairwise(begins)]
    bent = [optimise_path(*each) for each in zip(drives, nodes, solved, strict=True)]
    return JoinedDrives(tuple(bent), kept)


def loop_bias(loop: Loop, scale: float = 1.0) -> Drift:
    """Return the standard deviations of a loop that more matches do not improve."""
    if loop.same_frame:
        return Drift(0.0, 0.0)
    apart_m = float(np.linalg.norm(loop.T_first_last[:3, 3]))
    position_m = math.hypot(scale * _LOOP_SIGMA_M, _LOOP_RATIO * apart_m)
    return Drift(position_m, math.radians(_LOOP_SIGMA_DEG))


def misfit(edge: PoseEdge, T_world_node: Float64) -> float:
    """Return chi-square of an edge."""
    T = invert(T_world_node[edge.first]) @ T_world_node[edge.last]
    step = as_step(invert(edge.T_first_last) @ T)
    return float(step @ edge.information @ step)


def longest_segment(segment: NDArray[np.int64]) -> int:
    """Return the segment of a drive that has most frames."""
    return int(np.bincount(segment + 1, minlength=2)[1:].argmax())


def _spaced(
    drives: Sequence[DrivePath], constraints: Sequence[Constraint]
) -> list[NDArray[np.intp]]:
    """Return the frames of each drive that are nodes: evenly spaced, and those constrained."""
    ends: list[set[int]] = [set() for _ in drives]
    for constraint in constraints:
        ends[constraint.drives[0]].add(constraint.loop.first)
        ends[constraint.drives[1]].add(constraint.loop.last)
    constrained = [sorted(frames) for frames in ends]
    length_m = sum(float(drive.path_m[-1]) for drive in drives)
    gap_m = max(min(drive.scale for drive in drives) * _NODE_M, 2.0 * length_m / _MAX_NODES)
    if 2 * sum(map(len, constrained)) > _MAX_NODES:
        constrained = [[] for _ in drives]
    return [
        nodes_along(drive, gap_m, frames) for drive, frames in zip(drives, constrained, strict=True)
    ]


def nodes_along(drive: DrivePath, gap_m: float, constrained: Sequence[int]) -> NDArray[np.intp]:
    """Return evenly spaced frames of each segment, its first and last, and those constrained."""
    nodes = [np.array(constrained, np.intp)]
    if drive.segment.max() < 0:
        return np.zeros(1, np.intp)
    for number in range(int(drive.segment.max()) + 1):
        frames = np.flatnonzero(drive.segment == number)
        along_m = drive.path_m[frames] - drive.path_m[frames[0]]
        if along_m[-1] > 0.0:
            count = math.ceil(float(along_m[-1]) / gap_m) + 1
            marks = np.searchsorted(along_m, np.linspace(0.0, along_m[-1], count))
            nodes.append(frames[np.minimum(marks, len(frames) - 1)])
        nodes.append(frames[[0]] if along_m[-1] == 0.0 else frames[[0, -1]])
    chosen = np.unique(np.concatenate(nodes))
    rigid = drive.path_m[-1] == drive.path_m[0]
    return chosen[:1] if rigid else chosen


def _beside(
    start: Float64,
    parts: NDArray[np.int64],
    root: int,
    constraints: Sequence[Constraint],
    edges: Sequence[PoseEdge],
) -> Float64:
    """Return poses of nodes with each part where its best tie to those already placed has it."""
    poses: Float64 = start.copy()
    placed = {root}
    surest = sorted(zip(constraints, edges, strict=True), key=lambda each: -each[0].loop.inliers)
    while True:
        bridges = (
            edge
            for _, edge in surest
            if (int(parts[edge.first]) in placed) != (int(parts[edge.last]) in placed)
        )
        edge = next(bridges, None)
        if edge is None:
            return poses
        T = poses[edge.first] @ edge.T_first_last @ invert(poses[edge.last])
        there = int(parts[edge.first]) in placed
        moved = int(parts[edge.last if there else edge.first])
        poses[parts == moved] = (T if there else invert(T)) @ poses[parts == moved]
        placed.add(moved)


def _solve(
    start: Float64, steps: list[PoseEdge], constraints: list[PoseEdge], anchor: int = 0
) -> tuple[Float64, Float64]:
    """Return poses of the nodes, of which one is fixed, and the weights of the constraints."""
    edges, poses = [*steps, *constraints], start
    worst = max((misfit(edge, start) for edge in constraints), default=0.0)
    rounds = math.ceil(math.log(max(worst / _MAX_CHI2, 1.0), _EASING))
    for k in range(rounds, -1, -1):
        poses, weights = optimise_poses(poses, edges, _MAX_CHI2 * _EASING**k, anchor)
    return poses, weights[len(steps) :]


def odometry_edges(
    drive: DrivePath, nodes: NDArray[np.intp], begin: int, ratio: float
) -> list[PoseEdge]:
    """The edges along a drive, with a fraction of the possible drift, and all that is stated.

    Nodes are numbered from ``begin``.
    """
    poses, path_m = drive.trajectory.T_world_camera, drive.path_m
    edges = []
    for k, (first, last) in enumerate(pairwise(nodes), begin):
        if drive.segment[first] != drive.segment[last]:
            continue
        # Where the camera stands still, 0.1 m keeps the information finite.
        between_m = max(float(path_m[last] - path_m[first]), 0.1 * drive.scale)
        drift = drift_over(between_m, drive.scale)
        stated = np.repeat(drive.variance[last] - drive.variance[first], 3)
        T = invert(poses[first]) @ poses[last]
        covariance = ratio**2 * drift.covariance + np.diag(stated)
        edges.append(PoseEdge(k, k + 1, T, np.asarray(np.linalg.inv(covariance), np.float64)))
    return edges


def _constraint_edge(
    constraint: Constraint,
    drives: Sequence[DrivePath],
    nodes: Sequence[NDArray[np.intp]],
    begins: Sequence[int],
) -> PoseEdge:
    """Return a constraint as an edge between the nodes nearest to its frames."""
    loop, (one, other) = constraint.loop, constraint.drives
    first, to_first, before_m = _to_node(drives[one], nodes[one], loop.first)
    last, to_last, after_m = _to_node(drives[other], nodes[other], loop.last)
    scale = drives[one].scale
    drift, bias = drift_over(before_m + after_m, scale), loop_bias(loop, scale)
    more = Drift(*map(math.hypot, astuple(drift), astuple(bias)))
    turn = adjoint(invert(to_last))  # from the axes of the frame to those of its node
    covariance = np.linalg.inv(turn.T @ loop.information @ turn) + more.covariance
    T = orthonormalise(to_first @ loop.T_first_last @ invert(to_last))
    ends = begins[one] + first, begins[other] + last
    information = np.asarray(np.linalg.inv(covariance), np.float64)
    return PoseEdge(*ends, T, information, doubtful=True)


def _to_node(drive: DrivePath, nodes: NDArray[np.intp], frame: int) -> tuple[int, Float64, float]:
    """Return the node nearest to a frame, ``T_node_frame``, and the path between them."""
    poses, path_m = drive.trajectory.T_world_camera, drive.path_m
    away_m = np.abs(path_m[nodes] - path_m[frame])
    node = int(np.argmin(np.where(drive.segment[nodes] == drive.segment[frame], away_m, np.inf)))
    T = invert(poses[nodes[node]]) @ poses[frame]
    return node, T, float(away_m[node])


def optimise_path(drive: DrivePath, nodes: NDArray[np.intp], T_world_node: Float64) -> Trajectory:
    """Return every pose moved with the nodes before and after it, interpolated by distance."""
    old, path_m = drive.trajectory.T_world_camera, drive.path_m
    before = np.maximum(np.searchsorted(nodes, np.arange(len(old)), side="right") - 1, 0)
    after = np.minimum(before + 1, len(nodes) - 1)
    # A frame whose pose is not known goes on from the last node.
    same = drive.segment[nodes[after]] == drive.segment[nodes[before]]
    after = np.where(same, after, before)
    new = np.empty_like(old)
    for frame, (i, j) in enumerate(zip(before, after, strict=True)):
        a, b = nodes[i], nodes[j]
        from_a = T_world_node[i] @ invert(old[a]) @ old[frame]
        from_b = T_world_node[j] @ invert(old[b]) @ old[frame]
        span = float(path_m[b] - path_m[a])
        ratio = float(path_m[frame] - path_m[a]) / span if span > 0 else 0.0
        new[frame] = orthonormalise(pose_between(from_a, from_b, ratio))
    still = nodes[(T_world_node == old[nodes]).all(axis=(1, 2))]
    new[still] = old[still]  # which rounding has moved
    return replace(drive.trajectory, T_world_camera=new)
