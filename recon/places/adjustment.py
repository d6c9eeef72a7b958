"""The whole path adjusted once its loops are closed: keyframes and the points that they share.

A pose graph knows of a loop where its frames were measured to be, and of its neighbours what
odometry says. Here all keyframes agree at once on the points that they see: each is matched with
those before it and with those of its loops, about 10 ms for each pair. All other frames follow by
odometry, as between the nodes of a pose graph.
"""

from __future__ import annotations

import math
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace
from functools import lru_cache
from typing import Final, NamedTuple, Protocol

import numpy as np
from numpy.typing import NDArray
from scipy.sparse import coo_array
from scipy.sparse.csgraph import connected_components

from recon.core.geometry.se3 import invert
from recon.core.summary import Figures
from recon.core.values import RectifiedCamera, Trajectory
from recon.core.values.arrays import Float64
from recon.odometry.pose import INDEPENDENCE
from recon.places.align import CAUCHY_SIGMAS, SIGMA_D_PX
from recon.places.bundle import Bundle, Sightings, State
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
from recon.places.keyframe import feature_sigma_px
from recon.places.loop import Loop
from recon.places.pose_graph import PoseGraph, free_nodes
from recon.places.verify import Matchable, match_near

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

    keyframes: int
    points: int
    left_out_before_px: float  # median distance from where they should be
    left_out_after_px: float


@dataclass(frozen=True, eq=False)
class Adjustment:
    """An adjusted path, and how well it fits points that were left out."""

    trajectory: Trajectory
    keyframes: int  # that see any of the points
    points: int
    before_px: float  # median distance of what was left out from where it should be, before
    after_px: float  # and after

    def figures(self) -> AdjustmentFigures:
        return AdjustmentFigures(self.keyframes, self.points, self.before_px, self.after_px)


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
    return Adjustment(
        optimise_path(path, nodes, T_world_node),
        len(np.unique(known.seen.node)),
        known.seen.points,
        _median_px(test, before),
        _median_px(test, after),
    )


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


def _median_px(bundle: Bundle, state: State) -> float:
    """Return the median distance of what is seen from where it should be, in the image."""
    off = bundle.residuals_px(state)
    return float(np.nanmedian(np.hypot(off[:, 0], off[:, 1])))
