"""Writing the files of a map tile by tile, so that memory does not grow with the drive."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass
from typing import Final

import numpy as np

from recon.core.geometry.se3 import apply
from recon.core.geometry.transform import transform_cloud
from recon.core.values import OccupancyGrid, PointCloud
from recon.export.cloud_sample import CloudSample
from recon.export.occupancy import OccupancyWriter
from recon.io.models.ply import write_ply_tiles
from recon.map.sequence import MappedSequence
from recon.run.directory import RunDirectory
from recon.run.stopwatch import Stopwatch

SAMPLE_POINTS: Final = 300_000
"""Points of the fused cloud that are kept for display."""


@dataclass(frozen=True, eq=False)
class WrittenMap:
    """What is kept in memory of a map after its files are written.

    Attributes:
        cloud: Even sample of the fused cloud; all points of a small one. Frame ``map``.
        points: Number of points in the whole fused cloud.
        voxels: Number of observed voxels.
        grid: The flat grid.
        camera_height_m: As in `WrittenGrid`.
        warnings: What could not be written, or is not in the grid.
    """

    cloud: PointCloud
    points: int
    voxels: int
    grid: OccupancyGrid
    camera_height_m: float | None
    warnings: tuple[str, ...]


def write_map(mapped: MappedSequence, directory: RunDirectory, watch: Stopwatch) -> WrittenMap:
    """Write ``map/cloud.ply``, ``map/octomap.*`` and ``map/grid.*``.

    Args:
        mapped: The mapped drive.
        directory: Result folder of the run.
        watch: Times each stage.

    Raises:
        MappingError: Nothing was observed, or the height band of the grid is empty.
        OutputError: A file cannot be written.
    """
    path_m = apply(mapped.T_map_world, mapped.trajectory.positions_m)
    trusted = np.array([record.ok for record in mapped.health])
    writer = OccupancyWriter(mapped.map, mapped.config, path_m, trusted, directory)
    with watch.stage("cloud"):
        cloud, points = _write_cloud(mapped, directory, writer)
    with watch.stage("octomap"):
        voxels, warnings = writer.octomap()
    with watch.stage("grid"):
        written = writer.grid()
    told = (*warnings, *written.warnings)
    return WrittenMap(cloud, points, voxels, written.grid, written.camera_height_m, told)


def _write_cloud(
    mapped: MappedSequence, directory: RunDirectory, writer: OccupancyWriter
) -> tuple[PointCloud, int]:
    """Write the cloud; return a sample of it and its number of points."""
    sample = CloudSample(SAMPLE_POINTS, mapped.config.fusion.voxel_m)
    path = directory.path("map/cloud.ply")
    points = write_ply_tiles(path, _clouds(mapped, sample, writer), frame="map")
    kept = sample.cloud()
    nothing = PointCloud(np.zeros((0, 3), np.float32), frame="map")
    return nothing if kept is None else kept, points


def _clouds(
    mapped: MappedSequence, sample: CloudSample, writer: OccupancyWriter
) -> Iterator[PointCloud]:
    """The tiles of the fused cloud, in map axes."""
    for tile, cloud in mapped.map.cloud_tiles():
        in_map = transform_cloud(cloud, mapped.T_map_world, frame="map")
        sample.add(in_map)
        writer.put_cloud(tile, in_map)
        yield in_map
