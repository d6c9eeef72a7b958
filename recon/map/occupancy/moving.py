"""What moved: points of the fused cloud where rays of other frames went through.

Rays of a frame end two standard deviations before what they hit, so what is far or uncertain frees
nothing near itself; and a voxel in which a frame hit something is not freed by that frame. What is
left of a thing that moved are points in voxels that other frames saw through: later ones, after
which the voxel is free, or earlier ones, against whose number the few hits do not count.
"""

from __future__ import annotations

from dataclasses import replace
from typing import Final

import numpy as np
from numpy.typing import NDArray

from recon.core.geometry.se3 import apply
from recon.core.kernels.voxels import pack_keys
from recon.core.values import OccupancyVoxels
from recon.core.values.arrays import Bool, Float32, Float64
from recon.core.values.grid import log_odds
from recon.map.fusion.part import FusedPart
from recon.map.occupancy.builder import FREE_MARGIN_SIGMAS
from recon.map.occupancy.free_space import looked_through
from recon.map.occupancy.part import OccupancyPart

_FREE: Final = np.float32(log_odds(0.35))
"""Log-odds up to which a voxel is free: two rays more than even."""
_PASSED: Final = log_odds(0.12)
"""Sum of all evidence, clamped nowhere, up to which hits are those of something that passed."""
_LEAST_REACH: Final = 0.5
"""Share of a voxel by which a surface may stick out of the occupied ones."""


def passed_cells(part: OccupancyPart) -> NDArray[np.int64]:
    """Return int64 (N,), packed cells that a drive saw free in the end, or most of the time."""
    change, low, high = part.rows.values.T
    free = (np.minimum(np.maximum(change, low), high) <= _FREE) | (change <= _PASSED)
    return pack_keys(part.cells[free])


def find_moved(
    part: FusedPart,
    voxel_m: float,
    T_map_world: Float64,
    voxels: OccupancyVoxels,
    passed: NDArray[np.int64],
) -> Bool:
    """Return bool (N,), the rows of a part that something left which has moved.

    Args:
        part: What one drive fused.
        voxel_m: Edge of its voxels.
        T_map_world: float64 (4, 4).
        voxels: What all drives observed, map axes.
        passed: int64 (P,), the `passed_cells` of the same drive.
    """
    most = np.where(np.isin(pack_keys(voxels.keys), passed), _FREE, np.float32(np.inf))
    seen = replace(voxels, log_odds=np.minimum(voxels.log_odds, most))
    points = apply(T_map_world, part.points(voxel_m)).astype(np.float32)
    return looked_through(points, seen, _reach_m(part, voxels.resolution_m), _FREE)


def _reach_m(part: FusedPart, resolution_m: float) -> Float32:
    """Return float32 (N,), how far from its surface a frame may have put a point."""
    reach_m = np.full(len(part), _LEAST_REACH * resolution_m, np.float32)
    if "sigma_m" not in part.known:
        return reach_m
    of_a_frame = np.sqrt(part.frames / np.maximum(part.information, np.float32(1e-9)))
    return np.asarray(np.maximum(reach_m, FREE_MARGIN_SIGMAS * of_a_frame), np.float32)
