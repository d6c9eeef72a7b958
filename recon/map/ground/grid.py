"""From voxels to the 2-D grid that robots plan on, by heights above the local ground.

A camera that looks ahead never sees the ground on which it starts, and what passed in front of it
may have left hits. But where a vehicle drove there was nothing else, from the ground to the height
of its camera and as wide as it is. That counts more than what was seen before, and less than what
is seen on a later visit.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Annotated, Any, Final

import cv2
import numpy as np
from numpy.typing import NDArray
from pydantic import Field

from recon.core.errors import MappingError
from recon.core.settings import Settings
from recon.core.values import FREE, OCCUPIED, UNKNOWN, OccupancyGrid, OccupancyVoxels
from recon.core.values.arrays import Bool, Float64, Int32, Int64, freeze
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


_Height = Annotated[float, Field(ge=0.0, le=100.0)]
Band = tuple[_Height, _Height]
"""Lower and upper end of a band of heights."""


class GridSettings(Settings):
    """How voxels are flattened. Heights are of centres of voxels, above the local ground."""

    min_height_m: float = Field(0.3, ge=0.0, le=10.0)
    """Lower end of the band in which obstacles are looked for: what the vehicle can drive over."""
    max_height_m: float = Field(2.0, ge=0.01, le=100.0)
    """Upper end of the band: what is higher is passed under. The height of the vehicle, or of the
    robot that a costmap is for."""
    heights_m: tuple[Band, ...] = ()
    """Other bands, for robots or drones of other heights: each has a grid of its own beside that
    of the band above, such as [[0.1,0.5],[0.5,2]]."""
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
    if len(voxels) == 0:
        raise MappingError("nothing was observed: there is no map to flatten")
    if settings.max_height_m <= settings.min_height_m:
        band = f"{settings.min_height_m:g} to {settings.max_height_m:g} m"
        raise MappingError("the height band of the grid is empty", got=band)
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
    blocked = solid > 0
    _, labels, stats, _ = cv2.connectedComponentsWithStats(
        blocked.astype(np.uint8), connectivity=8, ltype=cv2.CV_32S
    )
    blocked &= (stats[:, cv2.CC_STAT_AREA] >= MIN_BLOB_CELLS)[labels]
    hit_low = number_in(hit & low_air) > 0
    free = (number_in(empty & low_air) > 0) & ~blocked & ~(hit_low & _beside(blocked))
    seen = number_in(empty & (height >= 0)) > 0
    unsure = (number_in(hit) > 0) & seen & ~blocked & ~free & ~_beside(free)
    window = np.ones((2 * JOINED_CELLS + 1, 2 * JOINED_CELLS + 1), np.uint8)
    blocked &= solid >= SMEAR_RATIO * cv2.dilate(solid.astype(np.float32), window)
    for _ in range(JOINED_CELLS):
        blocked |= unsure & _beside(blocked)
    cells = np.where(free, np.int8(FREE), np.int8(UNKNOWN))
    cells[blocked] = OCCUPIED
    origin = (float(low[0]) * voxels.resolution_m, float(low[1]) * voxels.resolution_m)
    return OccupancyGrid(cells, voxels.resolution_m, origin)


def ground_depths(voxels: OccupancyVoxels, ground: GroundSurface) -> Float64:
    """Return how far occupied voxels of the ground lie below it; float64 (N,), metres.

    As far as it is seen too low, it is seen too high elsewhere.
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
    cross = cv2.getStructuringElement(cv2.MORPH_CROSS, (3, 3))
    return np.asarray(cv2.dilate(cells.astype(np.uint8), cross) > 0)


_SAME_M: Final = 0.3
"""Heights of the camera above the ground that differ by less are those of one vehicle."""
_STEADY: Final = 0.8
"""Fraction of the path on which the height is the same, if something carries the camera."""


@dataclass(frozen=True, eq=False)
class DrivenPath:
    """The path of the camera in small steps, where its poses are trusted; map axes.

    ``points_m`` is float64 (P, 3), ``submap`` int64 (P,) the number of the submap of each point.
    """

    points_m: Float64
    submap: Int64

    def __post_init__(self) -> None:
        freeze(self, "points_m", np.float64, (None, 3))
        freeze(self, "submap", np.int64, (len(self.points_m),))

    @classmethod
    def through(cls, path_m: Float64, trusted: Bool, submap: Int64, step_m: float) -> DrivenPath:
        """Fill in the path (N, 3) between neighbouring poses that are both trusted."""
        length_m = np.linalg.norm(np.diff(path_m, axis=0), axis=1)
        joined = trusted[:-1] & trusted[1:]
        steps = np.where(joined, np.ceil(length_m / step_m), 1).astype(np.int64).clip(min=1)
        end = np.repeat(np.arange(1, len(path_m)), steps)
        left = np.repeat(np.cumsum(steps), steps) - np.arange(1, steps.sum() + 1)
        ratio = (left / np.repeat(steps, steps))[:, None]
        between = ratio * path_m[end - 1] + (1 - ratio) * path_m[end]
        keep = np.append(trusted[0], trusted[end])
        points = np.concatenate([path_m[:1], between])
        return cls(points[keep], np.append(submap[0], submap[end])[keep])

    def select(self, which: NDArray[Any]) -> DrivenPath:
        return DrivenPath(self.points_m[which], self.submap[which])


def is_driven(drops_m: Float64, camera_height_m: float) -> bool:
    """Return whether something carries the camera over the ground; a drone does not.

    ``drops_m`` (C,) are heights of the path above what was seen below it, place by place; a
    ``camera_height_m`` of NaN is unknown.
    """
    if not np.isfinite(camera_height_m):
        return False
    steady = np.abs(drops_m - camera_height_m) <= _SAME_M
    return bool(len(drops_m) == 0 or steady.mean() >= _STEADY)


def sweep(points_m: Float64, ground: GroundSurface, width_m: float, resolution_m: float) -> Int32:
    """Return the voxels that a vehicle took up, int32 (N, 3), each once.

    They are the columns that the path crosses and those with their centre within half a ``width_m``
    of it, from the ground up to the camera; none where something else than the ground was seen
    below it. ``points_m`` is its path, (P, 3), in steps of at most half a voxel; map axes.
    """
    off_m = np.abs(ground.drop_at(points_m[:, :2]) - ground.camera_height_m)
    on_ground = ~(off_m > _SAME_M)  # not above something else; ground that was not seen is ground
    # Columns (N, 2) near the path, each once, and its lowest height near each.
    points_m = points_m[on_ground]
    reach = int(np.ceil(width_m / 2 / resolution_m)) + 1
    around = np.stack(np.meshgrid(*[np.arange(-reach, reach + 1)] * 2), axis=-1).reshape(-1, 2)
    beside = np.floor(points_m[:, :2] / resolution_m).astype(np.int64)[:, None] + around
    offset = (beside + 0.5) * resolution_m - points_m[:, None, :2]
    near = (np.linalg.norm(offset, axis=2) <= width_m / 2) | (around == 0).all(axis=1)
    columns, place = np.unique(beside[near], axis=0, return_inverse=True)
    top_m = np.full(len(columns), np.inf)
    np.minimum.at(top_m, place.ravel(), points_m[np.nonzero(near)[0], 2])
    floor_m = ground.height_at((columns + 0.5) * resolution_m)
    known = np.isfinite(floor_m)
    columns, floor_m, top_m = columns[known], floor_m[known], top_m[known]
    first = np.ceil(floor_m / resolution_m - 0.5).astype(np.int64)
    last = np.maximum(first, np.floor(top_m / resolution_m - 0.5).astype(np.int64))
    number = last - first + 1
    above = np.arange(number.sum()) - np.repeat(np.cumsum(number) - number, number)
    keys = np.column_stack([np.repeat(columns, number, axis=0), np.repeat(first, number) + above])
    return keys.astype(np.int32)
