"""What moved: points of the fused cloud that were there at one time only.

First what may have moved is found, by all that a drive saw in a voxel: hits, and rays that passed
before and after. Rays of a frame end two standard deviations before what they hit, so what is far
or uncertain frees nothing near itself, and a voxel that a frame hit is not freed by that frame. One
voxel alone says little: someone who walks is hit in it nearly as often as it is seen through. So
evidence is averaged over the voxels around a point in which there are points. What a later drive
looked through is free, however often it was hit before.

No ray passes some of the places where something moved, such as its last ones in a drive. So where a
whole piece of surface was free, what moved grows into voxels that are not surely occupied, if half
of those beside them at the same height have moved: one of two along an upright surface; at a
straight edge on the ground it is three of eight, and nothing grows.

Then what single frames saw decides (`bodies.py`): fences, hedges, edges and noise are looked
through as well, but no frame sees a whole piece of them gone. Nor did a piece move whose surface is
still there, beside it by no more than the error of depths. A point that its frames
could not place in a voxel stays if something occupied is in its reach.

The ground is in reach of the lowest part of what moved, outvotes the voxels that touch it, and
shares one with what stood on it. So a voxel below what moved that is free itself moved as well, and
points below are judged once more, by what was seen of cells as fine as the rays that are kept.
"""

from __future__ import annotations

from itertools import product
from typing import Final

import numpy as np

from recon.core.kernels.voxels import are_among, find_keys, pack_keys
from recon.core.values import OccupancyVoxels
from recon.core.values.arrays import Bool, Float32, Float64, Int64
from recon.core.values.grid import log_odds
from recon.map.builders import (
    FREE_MARGIN_SIGMAS,
    HIT_PROBABILITY,
    MIN_PROBABILITY,
    MISS_PROBABILITY,
)
from recon.map.occupancy.bodies import (
    FrameObservations,
    Reaches,
    dynamic_cells,
    pairs_of,
    pieces_of,
    still_there,
    strides,
)
from recon.map.occupancy.gone import GONE
from recon.map.occupancy.part import OccupancyPart

_FREE: Final = np.float32(log_odds(0.35))
"""Log-odds up to which a voxel is free in the end: two rays more than even."""
_MOST: Final = np.float32(-log_odds(MIN_PROBABILITY))
"""Largest evidence of a voxel either way, so that none outvotes all others."""
_PLACED: Final = 0.45
"""Standard deviation of a frame, in voxels, up to which a point is in its voxel or beside it."""
_UNSURE: Final = _MOST / 2
"""Largest mean evidence around a voxel that may be of what moved beside it."""
_MUCH: Final = 0.02
"""Fraction of the points of a tile from which error is likelier to be underrated than all to
move."""
_SIGMAS: Final = (FREE_MARGIN_SIGMAS, 2 * FREE_MARGIN_SIGMAS)
"""Standard deviations that a body must have moved by; the second where so much would go."""
_INSIDE: Final = 8  # voxels that touch one inside a surface
GROWTH_CELLS: Final = 5  # voxels through which what moved grows
_AROUND: Final = np.array(list(product((-1, 0, 1), repeat=3)))
"""Steps to a cell itself and to those that touch it."""
_BESIDE: Final = _AROUND[(_AROUND[:, 2] == 0) & _AROUND[:, :2].any(axis=1)]
"""Steps to the cells that touch a cell at its own height."""
_ABOVE: Final = _AROUND[_AROUND[:, 2] == 1]
"""Steps to the cells that touch a cell from above."""
_OF_LOOK: Final = np.array([0.0, log_odds(HIT_PROBABILITY), log_odds(MISS_PROBABILITY)])
"""Log-odds of a frame that saw neither (0), hit (1) or looked through (-1) a cell."""
CellEvidence = tuple[Int64, Float32]
"""Packed cells int64 (N,), sorted, and what a drive saw in each, log-odds float32 (N,)."""


def cell_evidence(part: OccupancyPart) -> CellEvidence:
    """Return the sum of what a drive saw in its cells; what is free in the end counts as free."""
    change, low, high = part.rows.values.T
    end = np.minimum(np.maximum(change, low), high)
    evidence = np.where(end <= _FREE, np.minimum(change, end), change)
    keys = pack_keys(part.cells)
    order = np.argsort(keys)
    return keys[order], np.clip(evidence, -_MOST, _MOST)[order]


def find_moved(
    points: Float64,
    sigma_m: Float32,
    counted: Bool,
    voxels: OccupancyVoxels,
    evidence: CellEvidence,
    observations: FrameObservations,
) -> Bool:
    """Return bool (N,), the points (N, 3) fused by a drive that something left which has moved.

    ``sigma_m`` (N,) is the standard deviation of each in a frame; ``counted`` (N,) are those that
    enough frames saw, the voxels of others do not count. ``evidence`` is of the same drive;
    ``voxels`` and ``observations`` are what all drives and their frames observed. All is in map
    axes.
    """
    places = points / voxels.resolution_m
    packed = pack_keys(np.floor(places).astype(np.int64))
    placed = sigma_m <= _PLACED * voxels.resolution_m
    keys, home = np.unique(packed, return_inverse=True)
    moved, free_itself = _mostly_free(keys, _among(home, counted), voxels, evidence)
    occupied = pack_keys(voxels.keys[voxels.log_odds > 0])
    if moved.any():
        free = keys[moved]
        reaches = Reaches(free, voxels.resolution_m, observations.disagreement)
        frames = observations.by_frame(free)
        seen = reaches.noting((observations.T_map_camera[frame], look) for frame, look in frames)
        body = dynamic_cells(free, _among(home, counted & placed)[moved], seen)
        moved[moved], by_error = body, reaches.cells[body]
        for sigmas in _SIGMAS:
            rows = np.flatnonzero(moved)
            # Bodies of which at least half has a surface in its reach.
            others = np.sort(occupied[~are_among(occupied, keys[rows])])
            beside = still_there(keys[rows], sigmas * by_error, others)
            piece = pieces_of(len(rows), pairs_of(keys[rows])[0])
            stays = (np.bincount(piece, beside - 0.5) >= 0)[piece]
            moved[rows[stays]], by_error = False, by_error[~stays]
            if moved[home[counted]].sum() <= _MUCH * counted.sum():
                break
        lowest = np.flatnonzero(free_itself & ~moved)
        moved[lowest] = _touching(keys[lowest], keys[moved], _ABOVE) > 0
    moved = moved[home] | are_among(packed, pack_keys(voxels.keys[voxels.log_odds == GONE]))
    occupied = np.sort(occupied[~are_among(occupied, packed[moved & placed])])
    unsure = np.flatnonzero(moved & ~placed)
    reach = FREE_MARGIN_SIGMAS * sigma_m[unsure] / voxels.resolution_m
    moved[unsure] = ~_in_reach(places[unsure], reach, occupied)
    return moved | _left_below(points, packed, moved, observations.finest)


def _left_below(points: Float64, packed: Int64, moved: Bool, finest: FrameObservations) -> Bool:
    """Return bool (N,), points below those that moved whose finest cells were mostly free."""
    rows = np.flatnonzero(~moved)
    rows = rows[_touching(packed[rows], np.unique(packed[moved]), _ABOVE) > 0]
    found = np.zeros(len(points), np.bool_)
    if len(rows):
        cells = np.floor(points[rows] / finest.settings.resolution_m).astype(np.int64)
        keys, home = np.unique(pack_keys(cells), return_inverse=True)
        seen = sum((_OF_LOOK[look] for look in finest.at(keys)), np.zeros(len(keys)))
        found[rows] = (seen < 0)[home]
    return found


def _among(home: Int64, points: Bool) -> Bool:
    """Return bool (cells,), which cells have one of the points; ``home`` is the cell of each."""
    found = np.zeros(int(home.max(initial=-1)) + 1, np.bool_)
    found[home[points]] = True
    return found


def _mostly_free(
    keys: Int64, tells: Bool, voxels: OccupancyVoxels, evidence: CellEvidence
) -> tuple[Bool, Bool]:
    """Return two bool (N,): around which sorted cells most are free; which are free."""
    place, known = find_keys(keys, evidence[0])
    seen = np.full(len(keys), _MOST)
    seen[known] = evidence[1][place[known]]
    free_in_the_end = are_among(keys, pack_keys(voxels.keys[voxels.log_odds <= _FREE]))
    # What was there when the drive ended, and is free in the end, another drive looked through:
    # a later one; or an earlier one, where this one hit it hardly more often than by chance.
    seen[free_in_the_end & (seen > _FREE)] = -_MOST
    # Of those that touch each one; NaN where there are none.
    total, number = np.zeros((2, len(keys)), np.float32)
    among, values = keys[tells], seen[tells]
    for stride in strides(_AROUND):
        place, known = find_keys(keys + stride, among)
        total[known] += values[place[known]]
        number += known
    mean = np.divide(total, number, out=np.full_like(total, np.nan), where=number > 0)
    return _grown(keys, mean <= 0, mean <= _UNSURE), np.asarray(seen <= 0)


def _grown(keys: Int64, sure: Bool, unsure: Bool) -> Bool:
    """Return bool (N,), the sure ones of sorted keys, and the unsure ones that join a body."""
    body = np.zeros(len(keys), np.bool_)
    # More than that, as it is among them itself.
    body[sure] = _touching(keys[sure], keys[sure], _AROUND) > _INSIDE
    for _ in range(GROWTH_CELLS if body.any() else 0):
        rows = np.flatnonzero(unsure & ~body)
        moved, there = (_touching(keys[rows], among, _BESIDE) for among in (keys[body], keys))
        body[rows] = (moved > 0) & (2 * moved >= there)
    return sure | body


def _touching(wanted: Int64, keys: Int64, steps: Int64) -> Int64:
    """Return int64 (N,), how many of the sorted keys are some steps away from each wanted one."""
    number = np.zeros(len(wanted), np.int64)
    for stride in strides(steps):
        number += find_keys(wanted + stride, keys)[1]
    return number


def _in_reach(places: Float64, reach: Float32, keys: Int64) -> Bool:
    """Return bool (N,): places with one of the adjacent sorted keys in reach; in cells."""
    cells = np.floor(places).astype(np.int64)
    inside, near = places - cells, np.zeros(len(places), np.bool_)
    for step in _AROUND:
        gap = np.where(step < 0, inside, np.where(step > 0, 1 - inside, 0))
        close = np.flatnonzero(np.linalg.norm(gap, axis=1) <= reach)
        near[close] |= find_keys(pack_keys(cells[close] + step), keys)[1]
    return near


def looked_through(points: Float32, voxels: OccupancyVoxels) -> Bool:
    """Return bool (N,), points (N, 3) whose voxel is free, with no occupied one that touches it.

    Neighbours count because a surface along occupied voxels lies half in free ones. Unobserved
    space is not free.
    """
    cells = np.floor(points / np.float32(voxels.resolution_m)).astype(np.int64)
    keys = pack_keys(voxels.keys)
    _, through = find_keys(pack_keys(cells), np.sort(keys[voxels.log_odds <= 0]))
    occupied = np.sort(keys[voxels.log_odds > 0])
    rows = np.flatnonzero(through)
    through[rows] = _touching(pack_keys(cells[rows]), occupied, _AROUND) == 0
    return through
