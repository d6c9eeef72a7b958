"""The whole path adjusted once its loops are closed: keyframes and the points that they share.

A pose graph knows of a loop where its frames were measured to be, and of its neighbours what
odometry says. Here all keyframes agree at once on the points that they see: each is matched with
those before it and with those of its loops, about 10 ms for each pair. All other frames follow by
odometry, as between the nodes of a pose graph.

To what the edges of the graph cost comes, of each sighting of a point, ``c² log(1 + r²/c²)``, with
``r`` the difference of its column, row and disparity in standard deviations (Cauchy's loss). Their
normal equations are those of the window of visual odometry (`recon.odometry.kernels.bundle`), node
after node. The points are eliminated (Schur complement): what is left is sparse, since few nodes
see the same points. A sighting takes about 1 kB.

Ref: Triggs et al., "Bundle adjustment: a modern synthesis", 1999, section 6.
"""

from __future__ import annotations

import math
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace
from functools import cached_property, lru_cache
from typing import Final, NamedTuple, Protocol, TypeAlias

import numpy as np
from numpy.typing import NDArray
from scipy.sparse import bsr_array, coo_array, csc_array
from scipy.sparse.csgraph import connected_components

from recon.core.geometry.alignment import Problem, minimise
from recon.core.geometry.se3 import invert
from recon.core.summary import Figures
from recon.core.values import RectifiedCamera, Trajectory
from recon.core.values.arrays import Bool, Float64
from recon.core.values.camera import project
from recon.odometry.kernels import bundle
from recon.odometry.pose import INDEPENDENCE, model_of
from recon.places.closure import (
    USUAL,
    Closure,
    DrivePath,
    longest_segment,
    nodes_along,
    odometry_edges,
    optimise_path,
)
from recon.places.detector import StoredKeyframe
from recon.places.keyframe import feature_sigma_px, points_of
from recon.places.places import Loop
from recon.places.pose_graph import PoseGraph, free_nodes, solve_damped
from recon.places.verify import CAUCHY_SIGMAS, SIGMA_D_PX, Matchable, match_near

_BEFORE: Final = (1, 3)
"""By how many keyframes those are before each that it is matched with: the nearest, and one from
which points have moved more."""

_MOST_KEYFRAMES: Final = 4000  # of longer drives fewer are adjusted, evenly spaced
_MOST_SIGHTINGS: Final = 200_000  # more points are not adjusted: 200 MB, and some seconds a step
_HELD_OUT: Final = 10  # of so many points one is not adjusted, but tells whether the rest should be
_CACHED: Final = 64  # keyframes in memory
_CONTRADICTED: Final = 4.0  # standard deviations off at which a sighting contradicts its point


class StoredKeyframes(Protocol):
    """Keyframes of a drive, by the number of their frame."""

    @property
    def frames(self) -> list[int]: ...

    def get(self, frame: int) -> StoredKeyframe: ...


@dataclass(frozen=True)
class AdjustmentFigures(Figures):
    """How well a path fits points that were left out, before and after it was adjusted."""

    keyframes: int  # that see any of the points
    points: int
    left_out_before_px: float  # median distance from where they should be
    left_out_after_px: float


@dataclass(frozen=True, eq=False)
class Adjustment:
    """An adjusted path, and how well it fits points that were left out."""

    trajectory: Trajectory
    figures: AdjustmentFigures


def adjust_path(
    path: DrivePath, closure: Closure, keyframes: StoredKeyframes, camera: RectifiedCamera
) -> Adjustment | None:
    """Adjust a path whose loops are closed; None = points that were left out fit no better then.

    Fixed is the first pose of the longest segment, as for `close_loops`.
    """
    stride = math.ceil(len(keyframes.frames) / _MOST_KEYFRAMES)
    frames = keyframes.frames[::stride] if stride else []
    nodes = nodes_along(path, math.inf, frames)
    if not closure.closed or len(nodes) <= len(set(path.segment.tolist())):
        return None
    start = closure.trajectory.T_world_camera[nodes]
    pairs = list(_matched(path, closure, frames, keyframes, camera))
    if not pairs:
        return None
    seen = _tracks(pairs, nodes)
    edges = odometry_edges(path, nodes, 0, USUAL)
    graph = PoseGraph.of(edges, math.inf, len(nodes))
    ends = np.concatenate([graph.ends, np.searchsorted(nodes, [pair.nodes for pair in pairs])])
    anchor = int(np.argmax(path.segment[nodes] == longest_segment(path.segment)))
    graph = replace(graph, free=free_nodes(ends, len(nodes), anchor))
    left_out = np.arange(seen.points) % _HELD_OUT == 0
    sigma_px = feature_sigma_px(camera), SIGMA_D_PX
    known = Bundle(graph, seen.of_points(~left_out), camera, sigma_px, CAUCHY_SIGMAS)
    known = known.measured(known.fit(start), INDEPENDENCE)
    T_world_node = known.fit(start)[0]
    test = replace(
        known, graph=PoseGraph.of([], math.inf, len(nodes)), seen=seen.of_points(left_out)
    )
    before, after = test.fit(start), test.fit(T_world_node)
    if not test.cost(after) < test.cost(before):
        return None
    # How far what is seen is from where it should be, in the image.
    off_px = [np.hypot(*test.residuals_px(state)[:, :2].T) for state in (before, after)]
    seeing, medians = len(np.unique(known.seen.node)), (float(np.nanmedian(off)) for off in off_px)
    figures = AdjustmentFigures(seeing, known.seen.points, *medians)
    return Adjustment(optimise_path(path, nodes, T_world_node), figures)


class SharedPoints(NamedTuple):
    """Points that several keyframes see, where a path as it is puts them."""

    frames: NDArray[np.intp]  # (N,), the keyframes
    seen: Sightings  # of the points, by number of the keyframe
    xyz: Float64  # (P, 3), world


def shared_points(
    path: DrivePath,
    closure: Closure,
    keyframes: StoredKeyframes,
    camera: RectifiedCamera,
    among: Sequence[int],
) -> SharedPoints:
    """Return what several of the keyframes ``among`` those of a drive see.

    The path stays as it is. Points that one of the keyframes contradicts are left out.
    """
    frames = list(among)[:: max(1, math.ceil(len(among) / _MOST_KEYFRAMES))]
    pairs = list(_matched(path, closure, frames, keyframes, camera))
    nodes = np.array(frames, np.intp)
    if not pairs:
        none, nowhere = np.zeros(0, np.intp), np.zeros((0, 3))
        return SharedPoints(nodes, Sightings(none, none, nowhere), nowhere)
    seen, (uv_px, d_px) = _tracks(pairs, nodes), (feature_sigma_px(camera), SIGMA_D_PX)
    fixed = PoseGraph.of([], math.inf, len(nodes))
    bundle = Bundle(fixed, seen, camera, (uv_px, d_px), CAUCHY_SIGMAS)
    state = bundle.fit(closure.trajectory.T_world_camera[nodes])
    off = np.abs(bundle.residuals_px(state)) / [uv_px, uv_px, d_px]
    agree = np.ones(seen.points, np.bool_)
    agree[seen.point[~(off < _CONTRADICTED).all(axis=1)]] = False
    return SharedPoints(nodes, seen.of_points(agree), state[1][agree])


@dataclass(frozen=True, eq=False)
class _Matches:
    """What two nodes both see."""

    nodes: tuple[int, int]
    features: NDArray[np.intp]  # (K, 2), number of each feature in either
    uvd: Float64  # (2, K, 3), where


def _pairs(
    path: DrivePath, closure: Closure, frames: Sequence[int]
) -> Iterator[tuple[int, int, Float64 | None]]:
    """Yield keyframes that may see the same points, and their motion where a loop measured it."""
    loops: dict[int, list[Loop]] = {}
    for loop in closure.closed:
        loops.setdefault(loop.last, []).append(loop)
    known = set(frames)
    for number, last in enumerate(frames):
        for first in (frames[number - back] for back in _BEFORE if back <= number):
            if path.segment[first] == path.segment[last]:
                yield first, last, None
        for loop in loops.get(last, ()):
            if loop.first in known:
                yield loop.first, last, loop.T_first_last


def _matched(
    path: DrivePath,
    closure: Closure,
    frames: Sequence[int],
    keyframes: StoredKeyframes,
    camera: RectifiedCamera,
) -> Iterator[_Matches]:
    """Yield what pairs of keyframes both see."""

    @lru_cache(_CACHED)
    def features(frame: int) -> Matchable:
        return Matchable.of(keyframes.get(frame).keyframe, camera)

    poses = closure.trajectory.T_world_camera
    for first, last, measured in _pairs(path, closure, frames):
        T = invert(poses[first]) @ poses[last] if measured is None else measured
        ones, others = features(first), features(last)
        found = match_near(ones, others, T)
        if found is not None:
            rows = found[0]
            uvd = np.stack([ones.uvd[rows[:, 0]], others.uvd[rows[:, 1]]])
            yield _Matches((first, last), rows, uvd)


def _tracks(pairs: Sequence[_Matches], nodes: NDArray[np.intp]) -> Sightings:
    """Return where nodes see the points that matches are of, if no node sees one twice."""
    ends = np.searchsorted(nodes, [pair.nodes for pair in pairs])
    features = np.concatenate(
        [(end << 32) + pair.features for end, pair in zip(ends, pairs, strict=True)]
    )
    uvd = np.concatenate([pair.uvd for pair in pairs], axis=1)
    feature, row, number = np.unique(features.T, return_index=True, return_inverse=True)
    links = coo_array(
        (np.ones(len(features)), tuple(number.reshape(2, -1))), shape=(len(feature),) * 2
    )
    count, track = connected_components(links, directed=False)
    node = feature >> 32
    _, which, times = np.unique(
        track * np.int64(len(nodes)) + node, return_inverse=True, return_counts=True
    )
    once = np.ones(count, np.bool_)
    once[track[times[which] > 1]] = False
    seen = Sightings(node, track, uvd.reshape(-1, 3)[row]).of_points(once)
    stride = math.ceil(len(seen.node) / _MOST_SIGHTINGS)
    return seen.of_points(np.arange(seen.points) % max(1, stride) == 0)


_ROUNDS: Final = 12
_STILL: Final = 1e-4  # gain of a step, as a fraction of the cost, that is not worth another one
_OF_MEDIAN: Final = 1.4826  # standard deviations of a normal error in a median absolute one
_LEAST_PX: Final = 0.05  # however well features fit, they count as no better

State: TypeAlias = tuple[Float64, Float64]
"""Poses (N, 4, 4) of the nodes, and points (P, 3), in the world."""

_OneFrame: TypeAlias = tuple[Float64, Float64, Float64]
"""``T_camera_world``, what is seen, and points, as the kernel takes them."""


@dataclass(frozen=True, eq=False)
class Sightings:
    """Where nodes see points: in order of the nodes, each of which sees a point once."""

    node: NDArray[np.intp]  # (M,), ascending
    point: NDArray[np.intp]  # (M,), every number below P at least once
    uvd: Float64  # (M, 3), column, row, disparity

    @property
    def points(self) -> int:
        """Number of points, P."""
        return int(self.point.max(initial=-1)) + 1

    def of_points(self, chosen: Bool) -> Sightings:
        """Return those of some points (P,), numbered anew."""
        kept, number = chosen[self.point], np.cumsum(chosen) - 1
        return Sightings(self.node[kept], number[self.point[kept]], self.uvd[kept])


class _Linear(NamedTuple):
    """Normal equations: of the graph, nodes (N), points (P), and of both by sighting (M)."""

    graph: tuple[Float64, Float64]
    H_node: Float64  # (N, 6, 6)
    g_node: Float64  # (N, 6)
    H_point: Float64  # (P, 3, 3)
    g_point: Float64  # (P, 3)
    H_cross: Float64  # (M, 6, 3)


@dataclass(frozen=True, eq=False)
class Bundle:
    """The nodes of a graph, what they see, and how well."""

    graph: PoseGraph
    seen: Sightings
    camera: RectifiedCamera
    sigma_px: tuple[float, float]  # standard deviations of columns and rows, and of disparities
    cauchy_sigmas: float  # residual at which a sighting counts half

    def fit(self, T_world_node: Float64) -> State:
        """Fit the free nodes and all points, from poses."""
        # Each point begins where the node that is nearest to it sees it.
        order = np.lexsort((-self.seen.uvd[:, 2], self.seen.point))
        rows = order[np.unique(self.seen.point[order], return_index=True)[1]]
        T, xyz = T_world_node[self.seen.node[rows]], points_of(self.seen.uvd[rows], self.camera)
        points = np.einsum("pij,pj->pi", T[:, :3, :3], xyz) + T[:, :3, 3]
        problem = Problem(self.cost, self.linearise, self.step)
        start = T_world_node, np.asarray(points)
        return minimise(problem, start, rounds=_ROUNDS, min_gain=_STILL)

    def residuals_px(self, state: State) -> Float64:
        """Return predicted minus seen column, row, disparity (M, 3); NaN behind a camera."""
        T = invert(state[0])[self.seen.node]
        xyz = np.einsum("mij,mj->mi", T[:, :3, :3], state[1][self.seen.point]) + T[:, :3, 3]
        return np.stack(project(xyz, self.camera), axis=1) - self.seen.uvd

    def cost(self, state: State) -> float:
        costs = (bundle.cost(*each, tuple(self._model)) for _, _, each in self._by_node(state))
        return self.graph.cost(state[0]) + self.cauchy_sigmas**2 * sum(costs)

    def linearise(self, state: State) -> _Linear:
        """Return the normal equations; of gradients, half."""
        nodes, points = len(state[0]), self.seen.points
        found = _Linear(
            self.graph.linearise(state[0]),
            np.zeros((nodes, 6, 6)),
            np.zeros((nodes, 6)),
            np.zeros((points, 3, 3)),
            np.zeros((points, 3)),
            np.empty((len(self.seen.node), 6, 3)),
        )
        for node, rows, each in self._by_node(state):
            normal, seen = bundle.linearise(*each, self._model), self.seen.point[rows]
            found.H_node[node], found.g_node[node] = normal.H_pose[0], -normal.g_pose[0]
            found.H_cross[rows] = normal.H_cross[0]
            found.H_point[seen] += normal.H_point
            found.g_point[seen] -= normal.g_point
        return found

    def step(self, state: State, linear: _Linear, damping: float) -> State | None:
        """Return poses and points after a step; None where it has no solution."""
        raised = linear.H_point * (1.0 + damping * np.eye(3)) + bundle.RIDGE * np.eye(3)
        inverse = np.linalg.inv(raised)
        moved, change = state[0], np.zeros((len(inverse), 3))
        if self.graph.free.any():
            cross = self._by_free_node(linear.H_cross)
            folded = self._by_free_node(linear.H_cross @ inverse[self.seen.point])
            matrix, right = self.graph.equations(linear.graph)
            blocks = linear.H_node[self.graph.free]
            places = np.arange(len(blocks) + 1)
            diagonal = bsr_array((blocks, places[:-1], places), shape=(6 * len(blocks),) * 2)
            matrix = csc_array(matrix + diagonal - folded @ cross.T)
            right = right + linear.g_node[self.graph.free].ravel()
            found = solve_damped(matrix, right - folded @ linear.g_point.ravel(), damping)
            if found is None:
                return None
            moved, change = self.graph.moved(state[0], -found), (cross.T @ found).reshape(-1, 3)
        steps = np.einsum("pij,pj->pi", inverse, change - linear.g_point)
        return moved, state[1] + steps

    def measured(self, state: State, ratio: float) -> Bundle:
        """Return it with standard deviations as its residuals show them.

        ``ratio`` is that of the sightings whose errors count as independent.
        """
        off = np.abs(self.residuals_px(state))
        unknowns = 3 * self.seen.points + 6 * int(self.graph.free.sum())
        more = np.sqrt(off.size / max(off.size - unknowns, 1) / ratio)
        uv, d = (
            max(_OF_MEDIAN * float(np.nanmedian(part)), _LEAST_PX) * float(more)
            for part in (off[:, :2], off[:, 2])
        )
        return replace(self, sigma_px=(uv, d))

    @cached_property
    def _model(self) -> bundle.BundleModel:
        (sigma_uv, sigma_d), model = self.sigma_px, model_of(self.camera)
        return model._replace(sigma_uv=sigma_uv, sigma_d=sigma_d, cauchy=self.cauchy_sigmas)

    def _by_node(self, state: State) -> Iterator[tuple[int, slice, _OneFrame]]:
        """Yield each node that sees anything, which sightings, and them as a window of a frame."""
        T_node_world, xyz = invert(state[0]), state[1]
        nodes, begins = np.unique(self.seen.node, return_index=True)
        ends = [*begins[1:].tolist(), len(self.seen.node)]
        for node, begin, end in zip(nodes.tolist(), begins.tolist(), ends, strict=True):
            rows = slice(begin, end)
            at, uvd = T_node_world[node : node + 1], self.seen.uvd[rows][None]
            yield node, rows, (at, uvd, xyz[self.seen.point[rows]])

    def _by_free_node(self, blocks: Float64) -> bsr_array:
        """Return blocks (M, 6, 3) of sightings as a matrix, without the rows of fixed nodes."""
        free = self.graph.free
        kept, number = free[self.seen.node], np.cumsum(free) - 1
        begins = np.searchsorted(number[self.seen.node[kept]], np.arange(free.sum() + 1))
        shape = (6 * int(free.sum()), 3 * self.seen.points)
        return bsr_array((blocks[kept], self.seen.point[kept], begins), shape=shape)
