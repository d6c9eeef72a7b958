"""Ground from occupancy voxels: it reaches farther than the fused cloud, but is less precise."""

from __future__ import annotations

import math
from typing import Final

import numpy as np
from numpy.typing import NDArray

from recon.core.kernels.voxels import pack_keys
from recon.core.values import OccupancyVoxels, PointCloud
from recon.core.values.arrays import Bool, Float32, Int32
from recon.core.values.grid import log_odds
from recon.map.ground.surface import CELL_M, MAX_TILT_DEG, MIN_POINTS

_FULL: Final = log_odds(0.6)
_EMPTY: Final = log_odds(0.45)
_REACH: Final = 2
"""Evidence of a floor may be split over two voxels, so the free one may be the second above."""


def find_floors(voxels: OccupancyVoxels) -> Float32:
    """Return float32 (N, 3), centres of the occupied voxels with free space right above them.

    Walls have none. Voxels on another column do not matter, so tiles can be looked at alone.
    """
    return ((_floors(voxels) + 0.5) * voxels.resolution_m).astype(np.float32)


def add_floors(cloud: PointCloud, floors: Float32) -> PointCloud:
    """Return a cloud to look for ground in: its points, and floors where it has too few.

    Args:
        cloud: The fused cloud in map axes.
        floors: float32 (N, 3), as `find_floors` gives them.

    Returns:
        Points, and normals if the cloud has them (straight up for voxels); frame of the cloud.
    """
    known = cloud.xyz
    if cloud.normals is not None:
        known = known[cloud.normals[:, 2] >= math.cos(math.radians(MAX_TILT_DEG))]
    floors = floors[_unknown(floors, known)]
    xyz = np.concatenate([cloud.xyz, floors])
    if cloud.normals is None:
        return PointCloud(xyz, frame=cloud.frame)
    up = np.tile(np.array([0, 0, 1], np.float32), (len(floors), 1))
    return PointCloud(xyz, normals=np.concatenate([cloud.normals, up]), frame=cloud.frame)


def _floors(voxels: OccupancyVoxels) -> Int32:
    """Return int32 (N, 3), the occupied voxels that are free above."""
    if len(voxels) == 0:
        return voxels.keys
    packed = pack_keys(voxels.keys)
    order = np.argsort(packed)
    packed, log_odds = packed[order], voxels.log_odds[order]
    full = np.flatnonzero(log_odds > _FULL)
    free = np.zeros(len(full), dtype=np.bool_)
    roofed = np.zeros(len(full), dtype=np.bool_)
    for up in range(1, _REACH + 1):
        value = _value_at(packed, log_odds, packed[full] + up)
        free |= ~roofed & (value < _EMPTY)
        roofed |= value > _FULL
    return np.asarray(voxels.keys[order[full[free]]])


def _value_at(packed: NDArray[np.int64], log_odds: Float32, wanted: NDArray[np.int64]) -> Float32:
    """Return log-odds of cells among sorted ones; NaN where they were not observed."""
    place = np.minimum(np.searchsorted(packed, wanted), len(packed) - 1)
    return np.where(packed[place] == wanted, log_odds[place], np.float32(np.nan))


def _unknown(floors: Float32, known: Float32) -> Bool:
    """Return which floors lie in cells of the ground where fewer than ``min_points`` are known."""
    cells, counts = np.unique(_columns(known, CELL_M), return_counts=True)
    measured = cells[counts >= MIN_POINTS]
    return np.isin(_columns(floors, CELL_M), measured, invert=True)


def _columns(xyz: Float32, cell_m: float) -> NDArray[np.int64]:
    """Return one number for each point's cell of the ground."""
    cells = np.floor(xyz[:, :2].astype(np.float64) / cell_m).astype(np.int64)
    return np.asarray((cells[:, 0] << 32) + cells[:, 1])
