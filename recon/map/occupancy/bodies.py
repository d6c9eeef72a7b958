"""Which pieces of surface came or went as one body, by what each frame saw of them.

Two things are hit in some frames and looked through in others: what moved, and what is seen badly
or through its gaps, such as fences, hedges and glass. What moved was there as a whole at one time,
and free at another: in one frame its cells agree. Of a fence one frame hits some cells and looks
through others. So pairs of cells that touch are counted, frame by frame: those that a frame saw
differently, and those that it would have if each cell had been hit at random, as often as it was
(the join count of spatial statistics). A piece moved if the ratio of the two is small, over all
pairs and over those that lie one above the other: things that move are upright, and what is entered
by one edge first agrees from top to bottom.

Ref: P. A. P. Moran, "The interpretation of statistical maps", J. R. Statist. Soc. B 10, 1948.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Iterable, Iterator, Sequence
from functools import cached_property, lru_cache
from itertools import product
from typing import Final

import numpy as np
from scipy.sparse import coo_matrix
from scipy.sparse.csgraph import connected_components
from scipy.spatial import cKDTree

from recon.core.geometry.se3 import apply, invert
from recon.core.kernels.voxels import find_keys, pack_keys, unpack_keys
from recon.core.values import PointCloud, RayCloud, RectifiedCamera
from recon.core.values.arrays import Bool, Float64, Int8, Int64
from recon.map.builders import RAYS_PER_VOXEL, SPREAD_SIGMAS, OccupancySettings, frame_rays
from recon.map.kernels.observations import count_observation, rays_towards
from recon.map.kernels.raycast import (
    BLOCK_BITS,
    BLOCK_EDGE,
    blocks_of,
    cast_rays_into,
)
from recon.map.occupancy.gone import FrameView

_DISAGREEMENT: Final = 0.4
"""Largest disagreement within a body, root mean square of that of all and of upright pairs.

Rendered and real cars and walkers have 0.05 to 0.36; picket fences, hedges, roof edges and crowns
of trees 0.43 to 0.7, noise 1.
"""
_GAP_CELLS: Final = 2
"""Pieces about which too little is known belong to a body that is no farther away."""
_GAPS: Final = 3  # how many such gaps are crossed, one after the other
_LEAST_LOOKS: Final = 2
"""Frames that must have looked through a cell without neighbours to compare it with."""
_HALF: Final = np.array([s for s in product((-1, 0, 1), repeat=3) if s > (0, 0, 0)])
"""Steps to one of each two opposite neighbours."""


def dynamic_cells(keys: Int64, placed: Bool, observations: Iterable[Int8]) -> Bool:
    """Return bool (N,), the cells of pieces of surface that were there at one time only.

    ``keys`` are sorted packed cells with points that were seen through as often as hit; ``placed``
    those with points that their frames could place in one cell, the better evidence;
    ``observations`` what each frame saw in the cells, int8 (N,): 1 hit, -1 looked through, 0
    neither.
    """
    pairs, upright = pairs_of(keys)
    of_cells, before = np.zeros((3, len(keys)), np.int64), np.zeros(len(keys), np.int8)
    of_pairs = np.zeros((2, len(pairs)), np.int64)
    for look in observations:
        count_observation(look, before, of_cells, pairs, of_pairs)
    # How often frames hit each cell, looked through it, and began to hit it; how often they saw
    # both cells of a pair, and saw them differently.
    (hit, through, runs), (both, differed) = of_cells, of_pairs
    one, other = (hit / np.maximum(hit + through, 1))[pairs].T
    by_chance = both * (one * (1 - other) + other * (1 - one))
    piece = pieces_of(len(keys), pairs)
    home, pieces = piece[pairs[:, 0]], int(piece.max(initial=-1)) + 1

    def disagreement(which: Bool) -> Float64:
        """Return that of each piece, of all and of upright pairs; NaN where too little is known."""
        ratios = []
        for some in (which, which & upright):
            found = np.bincount(home[some], differed[some], pieces)
            expected = np.bincount(home[some], by_chance[some], pieces)
            out = np.full(pieces, np.nan)
            ratios.append(np.divide(found, expected, out=out, where=np.asarray(expected > 0)))
        return np.asarray(np.hypot(*ratios) / np.sqrt(2.0))

    # Cells whose points were not placed count where the others are too few to tell.
    sure = np.asarray(placed[pairs].all(axis=1))
    surely, at_all = disagreement(sure), disagreement(np.ones(len(pairs), np.bool_))
    number = np.bincount(home[sure & upright], minlength=pieces)
    told = np.abs(surely - _DISAGREEMENT) * np.sqrt(number) > surely  # by a standard error
    ratio = np.where(told, surely, at_all)[piece]
    known = np.isfinite(ratio)
    body = known & (ratio <= _DISAGREEMENT)
    for _ in range(_GAPS):
        near, among = np.zeros(len(keys), np.bool_), keys[body]
        for stride in _WITHIN_GAP:
            near |= find_keys(keys + stride, among)[1]
        body |= ~known & near
    # A few cells alone: hit in one run of frames, and looked through before or after.
    alone = (runs == 1) & (through >= _LEAST_LOOKS)
    return np.asarray(body | (~known & alone))


def pairs_of(keys: Int64) -> tuple[Int64, Bool]:
    """Return int64 (P, 2), rows of cells that touch; and which pairs lie one above the other."""
    found, upright = [], []
    for step, stride in zip(_HALF, strides(_HALF), strict=True):
        place, known = find_keys(keys + stride, keys)
        rows = np.flatnonzero(known)
        found.append(np.stack([rows, place[rows]], axis=1))
        upright.append(np.full(len(rows), not step[:2].any()))
    return np.concatenate(found), np.concatenate(upright)


def pieces_of(cells: int, pairs: Int64) -> Int64:
    """Return int64 (N,), number of the piece of each cell: cells that touch are of one."""
    graph = coo_matrix((np.ones(len(pairs), np.bool_), pairs.T), (cells, cells))
    return np.asarray(connected_components(graph, directed=False)[1], np.int64)


def strides(steps: Int64) -> Int64:
    """Return by how much packed cells differ that are some steps (N, 3) apart."""
    return pack_keys(steps) - pack_keys(np.zeros((1, 3), np.int64))


_WITHIN_GAP: Final = strides(np.array([*product(range(-_GAP_CELLS, _GAP_CELLS + 1), repeat=3)]))
_KEPT_FRAMES: Final = 192
"""Frames whose rays stay in memory, some 0.3 MB each: a tile needs those near it more than once."""


class FrameObservations:
    """The frames of all drives of a map, in order, taken at ``T_map_camera`` (F, 4, 4).

    ``rays`` gives the kept rays of a frame by its number here, ``settings`` how they become
    occupancy; ``frames`` are drive and frame of each, ``cameras`` theirs, where they are asked for.
    """

    def __init__(
        self,
        settings: OccupancySettings,
        T_map_camera: Float64,
        rays: Callable[[int], RayCloud],
        frames: Sequence[tuple[int, int]] = (),
        cameras: Sequence[RectifiedCamera] = (),
    ) -> None:
        self.settings, self.T_map_camera, self.frames = settings, T_map_camera, frames
        self._cameras = cameras
        self._read = lru_cache(_KEPT_FRAMES)(rays)

    def at(self, keys: Int64) -> Iterator[Int8]:
        """Yield what each frame near packed cells saw (N,): 1 hit, -1 through, 0 neither."""
        return (look for _, look in self.by_frame(keys))

    def by_frame(self, keys: Int64) -> Iterator[tuple[int, Int8]]:
        """Yield the same as `at`, after the number of each frame here."""
        cells = unpack_keys(keys).astype(np.int64)
        centres = (cells + 0.5) * self.settings.resolution_m
        reach_m = self.settings.max_range_m + self.settings.resolution_m
        # No cells are kept of a frame but those that are looked at, as places in blocks.
        homes, row = np.unique(pack_keys(cells >> BLOCK_BITS), return_inverse=True)
        column = np.ravel_multi_index(tuple((cells % BLOCK_EDGE).T), (BLOCK_EDGE,) * 3)
        blocks = blocks_of(homes)
        for frame in self._near(centres.min(axis=0), centres.max(axis=0), reach_m).tolist():
            T = self.T_map_camera[frame]
            ahead = apply(invert(T), centres)
            seen = (ahead[:, 2] > 0) & (np.linalg.norm(ahead, axis=1) < reach_m)
            if seen.any():
                cloud = self._read(frame).cloud()
                chosen = rays_towards(cloud.xyz, ahead[seen], self.settings.resolution_m)
                rays = frame_rays(cloud.select(chosen), T, self.settings)
                blocks.values[:] = 0
                cast_rays_into(blocks, rays, SPREAD_SIGMAS)
                yield frame, np.sign(blocks.values[row, column]).astype(np.int8)

    @cached_property
    def finest(self) -> FrameObservations:
        """The same frames, in cells as fine as their rays are kept."""
        cell_m = self.settings.resolution_m / RAYS_PER_VOXEL
        settings = self.settings.model_copy(update={"resolution_m": cell_m})
        return FrameObservations(settings, self.T_map_camera, self._read)

    @cached_property
    def disagreement(self) -> float:
        """By how much frames contradict each other: standard deviation of inverse depths, 1/m."""
        T, range_m = self.T_map_camera, self.settings.max_range_m
        clouds = (
            (*(self._read(n).cloud() for n in pair), invert(T[pair[1]]) @ T[pair[0]])
            for pair in frame_pairs(T, range_m)
        )
        return disagreement(clouds, self.settings)

    def near(self, low: Float64, high: Float64) -> Iterator[tuple[PointCloud, Float64]]:
        """Yield the rays of frames near a rectangle, camera axes, and ``T_map_camera`` of each."""
        for frame in self._near(low, high, self.settings.max_range_m):
            yield self._read(int(frame)).cloud(), self.T_map_camera[frame]

    def views(self, places_m: Float64) -> Iterator[FrameView]:
        """Yield the views of frames near places (N, 3), in order; none if cameras are unknown."""
        ends = places_m.min(axis=0), places_m.max(axis=0)
        for frame in self._near(*ends, self.settings.max_range_m) if self._cameras else ():
            yield self._read(int(frame)), self.T_map_camera[frame], self._cameras[frame]

    def _near(self, low: Float64, high: Float64, reach_m: float) -> Int64:
        """Return the frames from which something between two corners may be in reach."""
        places = self.T_map_camera[:, : len(low), 3]
        return np.flatnonzero(((places > low - reach_m) & (places < high + reach_m)).all(axis=1))


_PAIRS: Final = 24  # of frames, from all over a map, that are compared
_NEAR: Final = 0.25  # largest distance of two compared frames, in ranges
_SAME_WAY: Final = 0.7  # least cosine between the views of two compared frames
_NORMAL: Final = 1.4826  # standard deviation of normal errors, in medians of their sizes


def frame_pairs(T_map_camera: Float64, range_m: float) -> Iterator[tuple[int, int]]:
    """Yield pairs of frames near each other that look the same way, as far apart in time as any."""
    places, ahead = T_map_camera[:, :3, 3], T_map_camera[:, :3, 2]
    for frame in np.unique(np.linspace(0, len(places) - 1, _PAIRS).astype(int)).tolist():
        near = np.linalg.norm(places - places[frame], axis=1) <= _NEAR * range_m
        others = np.flatnonzero(near & (ahead @ ahead[frame] >= _SAME_WAY))
        other = int(others[np.abs(others - frame).argmax()])
        if other != frame:
            yield frame, other


def disagreement(
    views: Iterable[tuple[PointCloud, PointCloud, Float64]], settings: OccupancySettings
) -> float:
    """Return the standard deviation of an inverse depth, 1/m, by how frames contradict each other.

    ``views`` are the rays of two frames each, and what takes the first ones into the axes of the
    others. It is that of matching, rig and path together, as far as they differ between frames; 0
    where nothing is seen twice. What moves counts, too, but not if it is less than half.
    """
    off = np.concatenate([np.zeros(0), *(_off(*view, settings) for view in views)])
    return _NORMAL * float(np.median(np.abs(off))) if len(off) else 0.0


def _off(one: PointCloud, other: PointCloud, T_other_one: Float64, s: OccupancySettings) -> Float64:
    """Return by how much two frames disagree about rays that both have, as inverse depths, 1/m."""
    hits = (np.linalg.norm(cloud.xyz, axis=1) <= s.max_range_m for cloud in (one, other))
    there, seen = (
        cloud.xyz[hit & (cloud.xyz[:, 2] > 0)].astype(np.float64)
        for cloud, hit in zip((one, other), hits, strict=True)
    )
    moved = apply(T_other_one, there)
    ahead = moved[:, 2] > s.resolution_m
    if not len(seen) or not ahead.any():
        return np.zeros(0)
    own, moved = there[ahead, 2], moved[ahead]
    apart, at = cKDTree(seen[:, :2] / seen[:, 2:]).query(moved[:, :2] / moved[:, 2:])
    same = apart * moved[:, 2] < s.resolution_m / 2
    found = seen[at[same], 2]
    return np.asarray((found - moved[same, 2]) / np.hypot(own[same] ** 2, found**2))


class Reaches:
    """How far one standard deviation moves what frames hit in cells, along their rays."""

    def __init__(self, keys: Int64, resolution_m: float, error: float) -> None:
        self._centres = (unpack_keys(keys) + 0.5) * resolution_m
        self._by_depth = error / resolution_m
        self._sums, self._hits = np.zeros((len(keys), 3)), np.zeros((len(keys), 1))

    def noting(self, observations: Iterable[tuple[Float64, Int8]]) -> Iterator[Int8]:
        """Yield what each frame saw (N,), of those at ``T_map_camera``, and note what it hit."""
        for T_map_camera, look in observations:
            hit = np.flatnonzero(look > 0)
            depth = apply(invert(T_map_camera), self._centres[hit])[:, 2:]
            self._sums[hit] += (self._centres[hit] - T_map_camera[:3, 3]) * depth
            self._hits[hit] += 1
            yield look

    @property
    def cells(self) -> Float64:
        """float64 (N, 3), mean of the frames that hit each cell, in cells; 0 where none did."""
        return np.asarray(self._by_depth * self._sums / np.maximum(self._hits, 1))


def still_there(keys: Int64, reach: Float64, occupied: Int64) -> Bool:
    """Return bool (N,), packed cells with one of the sorted occupied ones in reach (N, 3) cells."""
    places, found = unpack_keys(keys) + 0.5, find_keys(keys, occupied)[1]
    for ratio in np.linspace(0, 1, math.ceil(2 * np.abs(reach).max(initial=0)) + 1)[1:]:
        for sign in (-ratio, ratio):
            cells = np.floor(places + sign * reach).astype(np.int64)
            found |= find_keys(pack_keys(cells), occupied)[1]
    return np.asarray(found)
