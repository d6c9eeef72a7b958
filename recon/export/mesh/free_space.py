"""Vertices in observed free space, where there can be no surface."""

from __future__ import annotations

from itertools import product

import numpy as np
from numpy.typing import NDArray

from recon.core.kernels.voxels import pack_keys
from recon.core.values import OccupancyVoxels
from recon.core.values.arrays import Bool, Float32


def looked_through(vertices: Float32, voxels: OccupancyVoxels) -> Bool:
    """Which vertices are in free space: their voxel is free, and no neighbour is occupied.

    Neighbours count because a surface along occupied voxels lies half in free ones.

    Args:
        vertices: float32 (V, 3), map axes.
        voxels: The observed voxels; unobserved space is not free.

    Returns:
        bool (V,).
    """
    if not len(voxels) or not len(vertices):
        return np.zeros(len(vertices), dtype=bool)
    cells = np.floor(vertices / np.float32(voxels.resolution_m)).astype(np.int64)
    taken = voxels.log_odds > 0
    free = _holds(np.sort(pack_keys(voxels.keys[~taken])), pack_keys(cells))
    occupied = np.sort(pack_keys(voxels.keys[taken]))
    rows = np.flatnonzero(free)
    near = np.zeros(len(rows), dtype=bool)
    for step in product((-1, 0, 1), repeat=3):
        near |= _holds(occupied, pack_keys(cells[rows] + np.array(step)))
    free[rows[near]] = False
    return free


def _holds(keys: NDArray[np.int64], wanted: NDArray[np.int64]) -> Bool:
    """bool (N,): which of the wanted keys are in the sorted ``keys``."""
    if not len(keys):
        return np.zeros(len(wanted), dtype=bool)
    place = np.minimum(np.searchsorted(keys, wanted), len(keys) - 1)
    return np.asarray(keys[place] == wanted)
