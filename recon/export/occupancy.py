"""Writing an occupancy map tile by tile, so that memory does not grow with the drive."""

from __future__ import annotations

import math
from collections.abc import Iterator
from dataclasses import dataclass
from itertools import product
from typing import Final

import numpy as np
from numpy.typing import NDArray

from recon.core.errors import MappingError
from recon.core.values import UNKNOWN, OccupancyGrid, OccupancyVoxels, PointCloud
from recon.core.values.arrays import Bool, Float64
from recon.export.ground_store import GroundStore, Window
from recon.io.occupancy.nav2 import write_nav2
from recon.io.occupancy.octomap import write_octomap_tiles
from recon.map import (
    DrivenPath,
    GroundSettings,
    GroundSurface,
    drop_undecided,
    estimate_ground_surface,
    find_floors,
    flatten,
    free_part,
    is_driven,
    measure_camera_height,
    sweep,
)
from recon.map.drive_map import DriveMap, Tile
from recon.map.log_odds import log_odds
from recon.map.occupancy import MIN_PROBABILITY
from recon.map.occupancy_part import OccupancyPart
from recon.map.settings import DriveSettings
from recon.run.directory import RunDirectory

_MARGIN_M: Final = 5.0
"""Least distance from the path to the edge of the grid: a footprint must fit in at the start."""


@dataclass(frozen=True, eq=False)
class WrittenGrid:
    """The grid of a drive, and what was found out for it.

    Attributes:
        grid: The grid.
        camera_height_m: Height above the ground at which something carried the camera; None =
            unknown, or not at one height.
        warnings: What a user of the grid should know.
    """

    grid: OccupancyGrid
    camera_height_m: float | None
    warnings: tuple[str, ...]


class OccupancyWriter:
    """Writes ``map/octomap.*`` and ``map/grid.*``; call the methods in the order below.

    `put_cloud` stores the fused cloud, from which the ground is estimated; `octomap` writes the
    octrees and stores floor voxels; `grid` needs both.

    Args:
        drive: The occupancy of the drive.
        config: The configuration.
        path_m: float64 (N, 3), camera positions in map axes.
        trusted: bool (N,), which of them are to be trusted.
        directory: The run's folder.
    """

    def __init__(
        self,
        drive: DriveMap,
        config: DriveSettings,
        path_m: Float64,
        trusted: Bool,
        directory: RunDirectory,
    ) -> None:
        self._drive = drive
        self._config = config
        self._path_m = path_m
        self._trusted = trusted
        self._directory = directory
        self._store = GroundStore(directory.state("ground"))
        self._resolution_m = config.occupancy.resolution_m
        self._edge_cells = drive.occupancy_tile_cells
        self._edge_m = self._edge_cells * self._resolution_m

    def put_cloud(self, tile: Tile, cloud: PointCloud) -> None:
        """Store a tile of the fused cloud, map axes.

        Raises:
            OutputError: It cannot be written.
        """
        self._store.put_cloud(tile, cloud)

    def octomap(self) -> tuple[int, list[str]]:
        """Write the octrees; return the number of voxels, and warnings.

        Raises:
            OutputError: A file cannot be written.
        """
        counts: list[int] = []
        tiles = self._known(counts)
        path, depth = self._directory.path("map/octomap"), self._edge_cells.bit_length() - 1
        try:
            write_octomap_tiles(path, tiles, depth, self._resolution_m)
        except MappingError as error:
            for _ in self._known(counts := []):  # stores the floors, which the grid needs
                continue
            return sum(counts), [f"no OctoMap: {error}"]
        return sum(counts), []

    def _known(self, counts: list[int]) -> Iterator[OccupancyVoxels]:
        """The occupied and free voxels of each tile; ``counts`` includes undecided ones."""
        for tile, wide in self._drive.occupancy_tiles():
            voxels = self._drive.inner(tile, wide)
            counts.append(len(voxels))
            self._store.put_floors(tile, find_floors(voxels))
            yield drop_undecided(voxels, self._config.grid)

    def grid(self) -> WrittenGrid:
        """Flatten the voxels, and write the grid.

        Raises:
            MappingError: Nothing was observed, or the height band of the grid is empty.
            OutputError: A file cannot be written.
        """
        if not len(self._drive.tiles):
            raise MappingError("nothing was observed: there is no map to flatten")
        settings, driven = self._along_the_path()
        low, high = self._extent()
        cells = np.full((high[1] - low[1], high[0] - low[0]), UNKNOWN, np.int8)
        path = self._driven_path() if driven else None
        for tile in dict.fromkeys((*self._drive.tiles, *self._crossed(_MARGIN_M))):
            part = self._flat(tile, settings, path)
            if part is not None:
                _paste(cells, low, part, tile, self._edge_cells)
            self._config.memory.check("putting the grid together")
        origin_m = (low[0] * self._resolution_m, low[1] * self._resolution_m)
        grid = OccupancyGrid(cells, self._resolution_m, origin_m)
        write_nav2(self._directory.path("map/grid"), grid)
        height_m = settings.camera_height_m
        return WrittenGrid(grid, height_m if driven else None, _warnings(height_m, driven))

    def _extent(self) -> tuple[Tile, Tile]:
        """Smallest x and y of the cells, and the largest ones plus one."""
        low, high = self._drive.columns
        path_m = self._path_m[self._trusted, :2]
        if not len(path_m):
            return low, high
        first = np.floor((path_m.min(axis=0) - _MARGIN_M) / self._resolution_m)
        last = np.ceil((path_m.max(axis=0) + _MARGIN_M) / self._resolution_m)
        low, high = np.minimum(low, first).astype(int), np.maximum(high, last).astype(int)
        return (int(low[0]), int(low[1])), (int(high[0]), int(high[1]))

    def _flat(
        self, tile: Tile, settings: GroundSettings, path: DrivenPath | None
    ) -> OccupancyGrid | None:
        """The grid of a tile and its margin; None without voxels or a path nearby."""
        window = Window.around(tile, self._edge_m, settings.reach_m)
        path_m = window.path(self._path_m)
        if not len(path_m):
            return None
        ground = estimate_ground_surface(self._store.cloud_in(window), path_m, settings)
        passed = {} if path is None else self._passed(tile, path, ground)
        voxels = self._drive.occupancy_of(tile, passed)
        return flatten(voxels, ground, self._config.grid) if len(voxels) else None

    def _passed(
        self, tile: Tile, path: DrivenPath, ground: GroundSurface
    ) -> dict[int, OccupancyPart]:
        """The space that the vehicle took up in a tile and its margin, by submap."""
        path = path.select(Window.around(tile, self._edge_m, _MARGIN_M).contains(path.points_m))
        width_m = self._config.grid.vehicle_width_m
        free = log_odds(MIN_PROBABILITY)
        passed = {}
        for submap in np.unique(path.submap).tolist():
            points_m = path.points_m[path.submap == submap]
            keys = sweep(points_m, ground, width_m, self._resolution_m)
            passed[submap] = free_part(keys, free)
        return passed

    def _driven_path(self) -> DrivenPath | None:
        """The path, if the vehicle has a width."""
        if self._config.grid.vehicle_width_m == 0:
            return None
        submap, step_m = self._drive.submap_of_frame, self._resolution_m / 2
        return DrivenPath.through(self._path_m, self._trusted, submap, step_m)

    def _crossed(self, margin_m: float) -> list[Tile]:
        """The tiles that the path touches, or comes near to at one of its poses."""
        corners = [np.array(side) * margin_m for side in product((-1, 1), repeat=2)]
        near = np.concatenate([self._path_m[:, :2] + corner for corner in corners])
        return [(x, y) for x, y in np.unique((near // self._edge_m).astype(int), axis=0).tolist()]

    def _along_the_path(self) -> tuple[GroundSettings, bool]:
        """The settings with one camera height for the whole drive, and whether it is driven."""
        settings, heights, drops = self._config.ground, [], [np.zeros(0)]
        for tile in self._crossed(0.0):
            window = Window.around(tile, self._edge_m, 0.0)
            cloud, path_m = self._store.cloud_in(window), window.path(self._path_m)
            height, along = measure_camera_height(cloud, path_m, settings)
            heights.append(height)
            drops.append(along)
        known = [height for height in heights if math.isfinite(height)]
        if settings.camera_height_m is None and known:
            settings = settings.model_copy(update={"camera_height_m": float(np.median(known))})
        found = settings.camera_height_m or math.nan
        return settings, is_driven(np.concatenate(drops), found)


def _warnings(camera_height_m: float | None, driven: bool) -> tuple[str, ...]:
    """What a user of the grid should know."""
    if driven:
        return ()
    if camera_height_m is None:
        text = "no ground was found below the path, so every cell of the grid is unknown"
    else:
        text = "the camera was not carried at one height above the ground: the grid has only what "
        text += "was seen, and the base of the trajectory in the map is the camera"
    return (text,)


def _paste(cells: NDArray[np.int8], low: Tile, part: OccupancyGrid, tile: Tile, edge: int) -> None:
    """Copy the part of a grid in a tile, ``edge`` cells a side, to cells that start at ``low``."""
    corner = np.rint(np.array(part.origin_m) / part.resolution_m).astype(int)
    size = np.array(part.cells.shape[::-1])
    begin = np.maximum(corner, np.array(tile) * edge)
    end = np.minimum(corner + size, (np.array(tile) + 1) * edge)
    if (begin >= end).any():
        return
    (x0, y0), (x1, y1) = begin - low, end - low
    (u0, v0), (u1, v1) = begin - corner, end - corner
    cells[y0:y1, x0:x1] = part.cells[v0:v1, u0:u1]
