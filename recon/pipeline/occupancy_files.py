"""Writing an occupancy map tile by tile, so that memory does not grow with the drive."""

from __future__ import annotations

import math
from collections.abc import Iterator

import numpy as np
from numpy.typing import NDArray

from recon.errors import MappingError
from recon.formats.nav2 import write_nav2
from recon.formats.octomap import write_octomap_tiles
from recon.mapping import (
    GroundSettings,
    drop_undecided,
    estimate_camera_height,
    estimate_ground_surface,
    find_floors,
    flatten,
)
from recon.pipeline.config import ReconConfig
from recon.pipeline.drive_map import DriveMap, Tile
from recon.pipeline.ground_store import GroundStore, Window
from recon.pipeline.run_directory import RunDirectory
from recon.structures import UNKNOWN, OccupancyGrid, OccupancyVoxels, PointCloud
from recon.structures.arrays import Float64


class OccupancyWriter:
    """Writes ``map/octomap.*`` and ``map/grid.*``; call the methods in the order below.

    `put_cloud` stores the fused cloud, from which the ground is estimated; `octomap` writes the
    octrees and stores floor voxels; `grid` needs both.

    Args:
        drive: The occupancy of the drive.
        config: The configuration.
        path_m: float64 (N, 3), camera positions in map axes.
        directory: The run's folder.
    """

    def __init__(
        self, drive: DriveMap, config: ReconConfig, path_m: Float64, directory: RunDirectory
    ) -> None:
        self._drive = drive
        self._config = config
        self._path_m = path_m
        self._directory = directory
        self._store = GroundStore(directory.state("ground"), config.ground)
        self._resolution_m = config.occupancy.resolution_m
        self._edge_cells = drive.occupancy_tile_cells

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

    def grid(self) -> OccupancyGrid:
        """Flatten the voxels and write the grid.

        Raises:
            MappingError: Nothing was observed, or the height band of the grid is empty.
            OutputError: A file cannot be written.
        """
        low, high = self._drive.columns
        if low == high:
            raise MappingError("nothing was observed: there is no map to flatten")
        cells = np.full((high[1] - low[1], high[0] - low[0]), UNKNOWN, np.int8)
        settings = self._with_camera_height()
        for tile, voxels in self._drive.occupancy_tiles():
            part = self._flat(tile, voxels, settings)
            if part is not None:
                _paste(cells, low, part, tile, self._edge_cells)
        origin_m = (low[0] * self._resolution_m, low[1] * self._resolution_m)
        grid = OccupancyGrid(cells, self._resolution_m, origin_m)
        write_nav2(self._directory.path("map/grid"), grid)
        return grid

    def _flat(
        self, tile: Tile, voxels: OccupancyVoxels, settings: GroundSettings
    ) -> OccupancyGrid | None:
        """The grid of a tile and its margin; None without voxels or a path nearby."""
        window = Window.around(tile, self._edge_cells * self._resolution_m, settings.reach_m)
        path_m = window.path(self._path_m)
        if not len(path_m) or not len(voxels):
            return None
        ground = estimate_ground_surface(self._store.cloud_in(window), path_m, settings)
        return flatten(voxels, ground, self._config.grid)

    def _with_camera_height(self) -> GroundSettings:
        """The settings with one camera height for the whole drive, if it can be measured."""
        settings = self._config.ground
        if settings.camera_height_m is not None:
            return settings
        edge_m, heights = self._edge_cells * self._resolution_m, []
        crossed = np.unique((self._path_m[:, :2] // edge_m).astype(int), axis=0).tolist()
        for column, row in crossed:
            window = Window.around((column, row), edge_m, 0.0)
            cloud, path_m = self._store.cloud_in(window), window.path(self._path_m)
            heights.append(estimate_camera_height(cloud, path_m, settings))
        known = [height for height in heights if math.isfinite(height)]
        found = {"camera_height_m": float(np.median(known))} if known else {}
        return settings.model_copy(update=found)


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
