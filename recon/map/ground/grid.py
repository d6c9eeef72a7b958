"""From voxels to the 2-D grid that robots plan on, by heights above the local ground."""

from __future__ import annotations

from typing import Final

import cv2
import numpy as np
from pydantic import Field

from recon.core.errors import MappingError
from recon.core.settings import Settings
from recon.core.values import FREE, OCCUPIED, UNKNOWN, OccupancyGrid, OccupancyVoxels
from recon.core.values.arrays import Bool, Float32, Float64, Int64
from recon.core.values.grid import log_odds
from recon.map.ground.surface import WINDOW_M, GroundSurface

JOINED_CELLS: Final = 2
"""Cells that were hit, but not surely, belong to an obstacle that they hang together with over so
many cells, unless they touch a free one."""
SMEAR_RATIO: Final = 1 / 8
"""Of the voxels of a column within so many cells, in a column that shows where hits of that one
scatter, and no obstacle of its own."""
FREE_HEIGHT_M: Final = 0.8
"""Free voxels below this height make a cell free; higher ones may be seen over an obstacle that
hides what is behind it."""
OCCUPIED_PROBABILITY: Final = 0.55
"""Voxels at least this probable are obstacles: a few hits, as OctoMap counts them, less misses."""
FREE_PROBABILITY: Final = 0.35  # voxels at most this probable are free


MIN_BLOB_CELLS: Final = 3  # fewer connected blocked cells are taken for noise


class GridSettings(Settings):
    """How voxels are flattened. Heights are of centres of voxels, above the local ground."""

    min_height_m: float = Field(0.3, ge=0.0, le=10.0)
    """Lower end of the band in which obstacles are looked for: what the vehicle can drive over."""
    max_height_m: float = Field(2.0, ge=0.01, le=100.0)
    """Upper end of the band: what is higher is passed under. The height of the vehicle, or of the
    robot that a costmap is for."""
    vehicle_width_m: float = Field(0.6, ge=0.0, le=10.0)
    """Width of what carried the camera: cells that it passed over are free; 0 = only what was seen
    is free."""


def flatten(
    voxels: OccupancyVoxels, ground: GroundSurface, settings: GridSettings
) -> OccupancyGrid:
    """Flatten an occupancy map to a grid with the resolution of the voxels that spans all of them.

    A cell is occupied where an occupied voxel lies in the height band above the ground of that
    place; not where there are few of them near a column of many, at which the hits of that one
    scatter. It is free where nothing is occupied and a free voxel lies low enough. That the ground
    was seen is no proof: it is also seen below a parked car. Where voxels in the band were hit, but
    none surely, it belongs to the obstacle beside it if nothing free is beside it, no ray came out
    between the two, and it was seen from above; behind a wall, hits of uncertain depth are only
    those of the wall. It is not free if it lies beside an obstacle and was hit as low as it is
    free. Everything else, and every cell without a known ground, is unknown.
    """
    _check(voxels, settings)
    low, (rows, columns), cell = _columns(voxels)
    height = _heights(voxels, ground)

    def number_in(which: Bool) -> Int64:
        return np.bincount(cell[which], minlength=rows * columns).reshape(rows, columns)

    s = settings
    hit = (height >= s.min_height_m) & (height <= s.max_height_m) & (voxels.log_odds > 0)
    low_air = (height >= 0) & (height <= FREE_HEIGHT_M)
    full = voxels.log_odds >= log_odds(OCCUPIED_PROBABILITY)
    empty = voxels.log_odds <= log_odds(FREE_PROBABILITY)
    solid = number_in(hit & full)
    blocked = _without_small_blobs(solid > 0, MIN_BLOB_CELLS)
    hit_low = number_in(hit & low_air) > 0
    free = (number_in(empty & low_air) > 0) & ~blocked & ~(hit_low & _beside(blocked))
    seen = number_in(empty & (height >= 0)) > 0
    unsure = (number_in(hit) > 0) & seen & ~blocked & ~free & ~_beside(free)
    blocked &= solid >= SMEAR_RATIO * _largest_around(solid)
    for _ in range(JOINED_CELLS):
        blocked |= unsure & _beside(blocked)
    cells = np.where(free, np.int8(FREE), np.int8(UNKNOWN))
    cells[blocked] = OCCUPIED
    origin = (float(low[0]) * voxels.resolution_m, float(low[1]) * voxels.resolution_m)
    return OccupancyGrid(cells, voxels.resolution_m, origin)


def _check(voxels: OccupancyVoxels, settings: GridSettings) -> None:
    if len(voxels) == 0:
        raise MappingError("nothing was observed: there is no map to flatten")
    if settings.max_height_m <= settings.min_height_m:
        raise MappingError(
            "the height band of the grid is empty",
            got=f"{settings.min_height_m:g} to {settings.max_height_m:g} m",
        )


def ground_depths(voxels: OccupancyVoxels, ground: GroundSurface) -> Float64:
    """Return how far occupied voxels of the ground lie below it; float64 (N,), metres.

    Nothing but ground is there, and as far as it is seen too low, it is seen too high elsewhere: by
    its roughness, by noise, and because a voxel stands for all within it.
    """
    if len(voxels) == 0:
        return np.zeros(0)
    below = -_heights(voxels, ground)
    full = voxels.log_odds >= log_odds(OCCUPIED_PROBABILITY)
    deepest_m = WINDOW_M + voxels.resolution_m / 2
    return np.asarray(below[full & (below >= 0) & (below <= deepest_m)])


def drop_undecided(voxels: OccupancyVoxels) -> OccupancyVoxels:
    """Return the voxels that are occupied or free; the others count as unknown.

    Programs that read an OctoMap call everything above 0.5 occupied, and the rest free: a voxel
    that a single uncertain ray touched would be either.
    """
    full = voxels.log_odds >= log_odds(OCCUPIED_PROBABILITY)
    empty = voxels.log_odds <= log_odds(FREE_PROBABILITY)
    return voxels.select(full | empty)


def _columns(voxels: OccupancyVoxels) -> tuple[Int64, tuple[int, int], Int64]:
    """Return the lowest column (2,), rows and columns of the grid, and the cell of each voxel."""
    # One axis after the other: along rows of three, numpy takes many times as long.
    x, y = (voxels.keys[:, axis].astype(np.int64) for axis in range(2))
    low = np.array([x.min(), y.min()])
    columns, rows = int(x.max() - low[0]) + 1, int(y.max() - low[1]) + 1
    return low, (rows, columns), (y - low[1]) * columns + (x - low[0])


def _heights(voxels: OccupancyVoxels, ground: GroundSurface) -> Float64:
    """Return float64 (N,), heights of the centres of voxels above the ground at their column."""
    low, shape, cell = _columns(voxels)
    row, column = np.divmod(np.arange(shape[0] * shape[1]), shape[1])
    xy = (np.stack([column, row], axis=1) + low + 0.5) * voxels.resolution_m
    floor = ground.height_at(xy)
    return np.asarray((voxels.keys[:, 2] + 0.5) * voxels.resolution_m - floor[cell])


def _beside(cells: Bool) -> Bool:
    """Return the cells of a mask, and those that share a side with one."""
    cross = cv2.getStructuringElement(cv2.MORPH_CROSS, (3, 3))
    return np.asarray(cv2.dilate(cells.astype(np.uint8), cross) > 0)


def _largest_around(numbers: Int64) -> Float32:
    """Return the largest number within `JOINED_CELLS` of each cell."""
    window = np.ones((2 * JOINED_CELLS + 1, 2 * JOINED_CELLS + 1), np.uint8)
    return np.asarray(cv2.dilate(numbers.astype(np.float32), window))


def _without_small_blobs(blocked: Bool, least: int) -> Bool:
    """Return the mask without connected blobs (8 neighbours) of fewer than ``least`` cells."""
    _, labels, stats, _ = cv2.connectedComponentsWithStats(
        blocked.astype(np.uint8), connectivity=8, ltype=cv2.CV_32S
    )
    large = stats[:, cv2.CC_STAT_AREA] >= least
    return np.asarray(blocked & large[labels])
