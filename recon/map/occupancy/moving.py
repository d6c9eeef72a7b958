"""What moved: points of the fused cloud where rays of other frames went through.

Rays of a frame end two standard deviations before what they hit, so what is far or uncertain frees
nothing near itself; and a voxel in which a frame hit something is not freed by that frame. All
that a drive saw in a voxel adds up: hits of a thing that was there, rays through it before and
after. One voxel alone tells little: someone who walks is hit in it nearly as often as it is seen
through, and the surface of a wall lies partly in voxels that rays pass. So evidence is averaged
over the voxels around a point in which there are points. What moved has left a whole body where
space was free; next to what stands, most voxels are surely occupied.

A point that its frames could not place in a voxel stays if something occupied is in its reach.
"""

from __future__ import annotations

from itertools import product
from typing import Final

import numpy as np
from numpy.typing import NDArray

from recon.core.kernels.voxels import pack_keys, unpack_keys
from recon.core.keys import are_among, find_keys
from recon.core.values import OccupancyVoxels
from recon.core.values.arrays import Bool, Float32, Float64
from recon.core.values.grid import log_odds
from recon.map.occupancy.builder import FREE_MARGIN_SIGMAS, MIN_PROBABILITY
from recon.map.occupancy.part import OccupancyPart

_FREE: Final = np.float32(log_odds(0.35))
"""Log-odds up to which a voxel is free in the end: two rays more than even."""
_MOST: Final = np.float32(-log_odds(MIN_PROBABILITY))
"""Largest evidence of a voxel either way, so that none outvotes all others."""
_PLACED: Final = 0.45
"""Standard deviation of a frame, in voxels, up to which a point is in its voxel or beside it."""
_AROUND: Final = np.array(list(product((-1, 0, 1), repeat=3)))
"""Steps to a cell itself and to those that touch it."""

CellEvidence = tuple[NDArray[np.int64], Float32]
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
) -> Bool:
    """Return bool (N,), the points of a drive that something left which has moved.

    Args:
        points: float64 (N, 3), what the drive fused, map axes.
        sigma_m: float32 (N,), standard deviation of each in a frame.
        counted: bool (N,), which of them enough frames saw; the voxels of others tell nothing.
        voxels: What all drives observed, map axes.
        evidence: The `cell_evidence` of the same drive.
    """
    places = points / voxels.resolution_m
    packed = pack_keys(np.floor(places).astype(np.int64))
    moved = _mostly_free(packed, counted, voxels, evidence)
    placed = sigma_m <= _PLACED * voxels.resolution_m
    occupied = pack_keys(voxels.keys[voxels.log_odds > 0])
    occupied = np.sort(occupied[~are_among(occupied, packed[moved & placed & counted])])
    unsure = np.flatnonzero(moved & ~placed)
    reach = FREE_MARGIN_SIGMAS * sigma_m[unsure] / voxels.resolution_m
    moved[unsure] = ~_in_reach(places[unsure], reach, occupied)
    return moved


def _mostly_free(
    packed: NDArray[np.int64], counted: Bool, voxels: OccupancyVoxels, evidence: CellEvidence
) -> Bool:
    """Return bool (N,), whether the voxels around points, in which there are points, are free."""
    keys, home = np.unique(packed, return_inverse=True)
    place, known = find_keys(keys, evidence[0])
    seen = np.full(len(keys), _MOST)
    seen[known] = evidence[1][place[known]]
    free_in_the_end = are_among(keys, pack_keys(voxels.keys[voxels.log_odds <= _FREE]))
    seen[free_in_the_end] = np.minimum(seen[free_in_the_end], _FREE)
    tells = np.zeros(len(keys), np.bool_)
    tells[home[counted]] = True
    return np.asarray((_mean_around(keys, keys[tells], seen[tells]) <= 0)[home])


def _mean_around(wanted: NDArray[np.int64], keys: NDArray[np.int64], values: Float32) -> Float32:
    """Return float32 (N,), the mean value of the sorted keys that touch each wanted one or are it.

    NaN where there are none.
    """
    total, number = np.zeros((2, len(wanted)), np.float32)
    cells = unpack_keys(wanted)
    for step in _AROUND:
        place, known = find_keys(pack_keys(cells + step), keys)
        total[known] += values[place[known]]
        number += known
    return np.divide(total, number, out=np.full_like(total, np.nan), where=number > 0)


def _in_reach(places: Float64, reach: Float32, keys: NDArray[np.int64]) -> Bool:
    """Return bool (N,): places with one of the sorted keys in reach; lengths in cells.

    Only those that touch the cell of the place are looked at.
    """
    cells = np.floor(places).astype(np.int64)
    inside, near = places - cells, np.zeros(len(places), np.bool_)
    for step in _AROUND:
        gap = np.where(step < 0, inside, np.where(step > 0, 1 - inside, 0))
        close = np.flatnonzero(np.linalg.norm(gap, axis=1) <= reach)
        near[close] |= find_keys(pack_keys(cells[close] + step), keys)[1]
    return near
