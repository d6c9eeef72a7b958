"""Points in observed free space, where there can be no surface."""

from __future__ import annotations

from itertools import product
from typing import Final

import numpy as np

from recon.core.kernels.voxels import find_keys, pack_keys
from recon.core.values import OccupancyVoxels
from recon.core.values.arrays import Bool, Float32

_EVEN: Final = np.float32(0)


def looked_through(points: Float32, voxels: OccupancyVoxels) -> Bool:
    """Return which points are in free space: their voxel is free, and no occupied one touches it.

    Neighbours count because a surface along occupied voxels lies half in free ones.

    Args:
        points: float32 (N, 3), map axes.
        voxels: The observed voxels; unobserved space is not free.

    Returns:
        bool (N,).
    """
    cells = np.floor(points / np.float32(voxels.resolution_m)).astype(np.int64)
    keys = pack_keys(voxels.keys)
    _, through = find_keys(pack_keys(cells), np.sort(keys[voxels.log_odds <= _EVEN]))
    occupied = np.sort(keys[voxels.log_odds > 0])
    rows = np.flatnonzero(through)
    for step in product((-1, 0, 1), repeat=3):
        _, near = find_keys(pack_keys(cells[rows] + np.array(step)), occupied)
        through[rows[near]] = False
    return through
