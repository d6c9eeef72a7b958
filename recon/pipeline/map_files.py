"""The files of a map, written tile by tile: memory does not grow with the drive."""

from __future__ import annotations

import math
from collections.abc import Iterator
from dataclasses import dataclass
from typing import Final

import numpy as np
from numpy.typing import NDArray

from recon.errors import MappingError
from recon.formats.nav2 import write_nav2
from recon.formats.octomap import write_octomap_tiles
from recon.formats.ply import write_ply_tiles
from recon.geometry.se3 import apply
from recon.geometry.transform import transform_cloud
from recon.mapping import (
    GroundSettings,
    drop_undecided,
    estimate_camera_height,
    estimate_ground_surface,
    find_floors,
    flatten,
)
from recon.pipeline.cloud_sample import CloudSample
from recon.pipeline.drive_map import Tile
from recon.pipeline.ground_store import GroundStore, Window
from recon.pipeline.run_directory import RunDirectory
from recon.pipeline.sequence import MappedSequence
from recon.pipeline.stopwatch import Stopwatch
from recon.structures import UNKNOWN, OccupancyGrid, OccupancyVoxels, PointCloud

SAMPLE_POINTS: Final = 300_000
"""Points of the fused cloud that are kept to look at."""


@dataclass(frozen=True, eq=False)
class WrittenMap:
    """What is known of a map whose files are written.

    Attributes:
        cloud: Points of the fused cloud, spread evenly; all of a small one. Frame ``map``.
        points: Number of points of the whole.
        voxels: Number of observed voxels.
        grid: The flat grid.
        warnings: What could not be written.
    """

    cloud: PointCloud
    points: int
    voxels: int
    grid: OccupancyGrid
    warnings: tuple[str, ...]


def write_map(mapped: MappedSequence, directory: RunDirectory, watch: Stopwatch) -> WrittenMap:
    """Write ``map/cloud.ply``, ``map/octomap.*`` and ``map/grid.*``.

    Args:
        mapped: The drive.
        directory: Its folder.
        watch: Told the seconds per stage.

    Raises:
        MappingError: Nothing was observed, or the height band of the grid is empty.
        OutputError: A file cannot be written.
    """
    writer = _MapWriter(mapped, directory)
    with watch.stage("cloud"):
        cloud, points = writer.cloud()
    with watch.stage("octomap"):
        voxels, warnings = writer.octomap()
    with watch.stage("grid"):
        grid = writer.grid()
    return WrittenMap(cloud, points, voxels, grid, tuple(warnings))


class _MapWriter:
    """Writes the files in the order in which each needs what the ones before put by."""

    def __init__(self, mapped: MappedSequence, directory: RunDirectory) -> None:
        self._mapped = mapped
        self._directory = directory
        self._store = GroundStore(directory.state("ground"), mapped.config.ground)
        self._resolution_m = mapped.config.occupancy.resolution_m
        self._edge_cells = mapped.map.occupancy_tile_cells

    def cloud(self) -> tuple[PointCloud, int]:
        """Write the cloud; a sample of it and the number of its points."""
        sample = CloudSample(SAMPLE_POINTS, self._mapped.config.fusion.voxel_m)
        path = self._directory.path("map/cloud.ply")
        points = write_ply_tiles(path, self._clouds(sample), frame="map")
        kept = sample.cloud()
        nothing = PointCloud(np.zeros((0, 3), np.float32), frame="map")
        return nothing if kept is None else kept, points

    def _clouds(self, sample: CloudSample) -> Iterator[PointCloud]:
        """The tiles in map axes."""
        for tile, cloud in self._mapped.map.cloud_tiles():
            in_map = transform_cloud(cloud, self._mapped.T_map_world, frame="map")
            sample.add(in_map)
            self._store.put_cloud(tile, in_map)
            yield in_map

    def octomap(self) -> tuple[int, list[str]]:
        """Write the octrees; the number of voxels, and warnings."""
        counts: list[int] = []
        tiles = self._known(counts)
        path, depth = self._directory.path("map/octomap"), self._edge_cells.bit_length() - 1
        try:
            write_octomap_tiles(path, tiles, depth, self._resolution_m)
        except MappingError as error:
            for _ in self._known(counts := []):  # the floors are needed all the same
                continue
            return sum(counts), [f"no OctoMap: {error}"]
        return sum(counts), []

    def _known(self, counts: list[int]) -> Iterator[OccupancyVoxels]:
        """The voxels that are occupied or free; all are counted."""
        tiles = self._mapped.map
        for tile, wide in tiles.occupancy_tiles():
            voxels = tiles.inner(tile, wide)
            counts.append(len(voxels))
            self._store.put_floors(tile, find_floors(voxels))
            yield drop_undecided(voxels, self._mapped.config.grid)

    def grid(self) -> OccupancyGrid:
        """Flatten the voxels and write the grid."""
        low, high = self._mapped.map.columns
        if low == high:
            raise MappingError("nothing was observed: there is no map to flatten")
        cells = np.full((high[1] - low[1], high[0] - low[0]), UNKNOWN, np.int8)
        settings = self._with_camera_height()
        for tile, voxels in self._mapped.map.occupancy_tiles():
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
        """The grid of a tile and its margin; None where no path is near, so no ground is known."""
        window = Window.around(tile, self._edge_cells * self._resolution_m, settings.reach_m)
        path_m = window.path(self._path_m)
        if not len(path_m) or not len(voxels):
            return None
        ground = estimate_ground_surface(self._store.cloud_in(window), path_m, settings)
        return flatten(voxels, ground, self._mapped.config.grid)

    def _with_camera_height(self) -> GroundSettings:
        """The settings with one height for the whole drive, where it can be measured."""
        settings = self._mapped.config.ground
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

    @property
    def _path_m(self) -> NDArray[np.float64]:
        """float64 (N, 3), the path in map axes."""
        return apply(self._mapped.T_map_world, self._mapped.trajectory.positions_m)


def _paste(cells: NDArray[np.int8], low: Tile, part: OccupancyGrid, tile: Tile, edge: int) -> None:
    """Copy what a grid has of a tile, ``edge`` cells a side, to cells that begin at ``low``."""
    corner = np.rint(np.array(part.origin_m) / part.resolution_m).astype(int)
    size = np.array(part.cells.shape[::-1])
    begin = np.maximum(corner, np.array(tile) * edge)
    end = np.minimum(corner + size, (np.array(tile) + 1) * edge)
    if (begin >= end).any():
        return
    (x0, y0), (x1, y1) = begin - low, end - low
    (u0, v0), (u1, v1) = begin - corner, end - corner
    cells[y0:y1, x0:x1] = part.cells[v0:v1, u0:u1]
