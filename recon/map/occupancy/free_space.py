"""Points in observed free space, where there can be no surface."""

from __future__ import annotations

from itertools import product
from typing import Final

import numpy as np
from numpy.typing import NDArray

from recon.core.kernels.voxels import pack_keys
from recon.core.values import OccupancyVoxels
from recon.core.values.arrays import Bool, Float32

_EVEN: Final = np.float32(0)


def looked_through(
    points: Float32,
    voxels: OccupancyVoxels,
    reach_m: Float32 | None = None,
    free: np.float32 = _EVEN,
) -> Bool:
    """Return which points are in free space: their voxel is free, and nothing occupied is in reach.

    Neighbours count because a surface along occupied voxels lies half in free ones.

    Args:
        points: float32 (N, 3), map axes.
        voxels: The observed voxels; unobserved space is not free.
        reach_m: float32 (N,), distance within which an occupied voxel may be that of the point;
            only those that touch its own voxel are looked at. None = all of them.
        free: Log-odds up to which a voxel is free.

    Returns:
        bool (N,).
    """
    if not len(voxels) or not len(points):
        return np.zeros(len(points), dtype=bool)
    places = points / np.float32(voxels.resolution_m)
    cells = np.floor(places).astype(np.int64)
    keys = pack_keys(voxels.keys)
    through = _holds(np.sort(keys[voxels.log_odds <= free]), pack_keys(cells))
    occupied = np.sort(keys[voxels.log_odds > 0])
    rows = np.flatnonzero(through)
    inside, cells = places[rows] - cells[rows], cells[rows]
    reach = np.inf if reach_m is None else reach_m[rows] / voxels.resolution_m
    near = np.zeros(len(rows), dtype=bool)
    for step in np.array(list(product((-1, 0, 1), repeat=3))):
        gap = np.where(step < 0, inside, np.where(step > 0, 1 - inside, 0))
        close = np.linalg.norm(gap, axis=1) <= reach
        near[close] |= _holds(occupied, pack_keys(cells[close] + step))
    through[rows[near]] = False
    return through


def _holds(keys: NDArray[np.int64], wanted: NDArray[np.int64]) -> Bool:
    """Return bool (N,): which of the wanted keys are in the sorted ``keys``."""
    if not len(keys):
        return np.zeros(len(wanted), dtype=bool)
    place = np.minimum(np.searchsorted(keys, wanted), len(keys) - 1)
    return np.asarray(keys[place] == wanted)
