"""The fused cloud of a map as files, and an even sample of it for images and reports."""

from __future__ import annotations

from collections import deque
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Final

import numpy as np
from numpy.typing import NDArray

from recon.core.kernels import voxels
from recon.core.values import PointCloud, join_clouds
from recon.export.product import ExportContext, ExportResult, PointFigures
from recon.io.models.npz import write_npz
from recon.io.models.pcd import write_pcd
from recon.io.models.ply import write_ply_tiles
from recon.map.tiles import Tiles

SAMPLE_POINTS: Final = 300_000  # points of the fused cloud that are kept for display
_GROWTH: Final = 1.25
_MUCH: Final = 0.02  # fraction of the points left out without a word; a busy street has less


@dataclass(frozen=True)
class CloudFigures(PointFigures):
    """The fused cloud, without what moved."""

    points_removed: int


def cloud_product(context: ExportContext, path: Path) -> ExportResult:
    """Write the fused cloud, and ``removed.ply`` beside it with what moved."""
    return export_cloud(context.placed.tiles, path, path.with_name("removed.ply"))


def pcd_product(context: ExportContext, path: Path) -> ExportResult:
    """Write the fused cloud for PCL."""
    clouds = (tile.cloud for tile in context.placed.tiles)
    return ExportResult(PointFigures(write_pcd(path, clouds)))


def arrays_product(context: ExportContext, path: Path) -> ExportResult:
    """Write an archive of NumPy: the fields of the fused cloud, and the paths of the drives.

    ``xyz`` and the other fields of `PointCloud` that the map has; and for each frame ``times_s``,
    ``T_map_camera`` (F, 4, 4), ``placed`` (whether it has a place in the map) and ``session``.
    """
    drives = context.map.linked
    paths = [drive.T_map_world @ drive.trajectory.T_world_camera for drive in drives]
    whole: dict[str, list[NDArray[Any]]] = {
        "times_s": [drive.trajectory.timestamps_s for drive in drives],
        "T_map_camera": paths,
        "placed": [context.map.placed[drive.number] for drive in drives],
        "session": [np.full(len(drive), drive.number) for drive in drives],
    }
    points = write_npz(
        path,
        (tile.cloud.arrays for tile in context.placed.tiles if len(tile.cloud)),
        {name: np.concatenate(each) for name, each in whole.items()},
    )
    return ExportResult(PointFigures(points))


def export_cloud(tiles: Tiles, path: Path, removed: Path | None = None) -> ExportResult:
    """Write the points of all tiles into a PLY file, and perhaps what was removed into another.

    A report shows an even sample of the cloud; all points of a small one. Frame ``map``.
    """
    sample = CloudSample(SAMPLE_POINTS, tiles.config.fusion.voxel_m)
    points = write_ply_tiles(path, sample.passing(tiles), frame="map")
    left_out = 0
    if removed is not None and tiles.config.fusion.remove_moving:
        moved = (tile.removed for tile in tiles)
        left_out = write_ply_tiles(removed, moved, frame="map")
    return ExportResult(
        CloudFigures(points, left_out), _doubts(tiles, points, left_out), sample.cloud()
    )


def even_sample(tiles: Tiles) -> PointCloud:
    """Return an even sample of the cloud of a map, all points of a small one; frame ``map``."""
    sample = CloudSample(SAMPLE_POINTS, tiles.config.fusion.voxel_m)
    deque(sample.passing(tiles), maxlen=0)
    return sample.cloud()


def _doubts(tiles: Tiles, points: int, removed: int) -> list[str]:
    """Return a warning where much was left out, or nothing could be."""
    if tiles.config.fusion.remove_moving and tiles.observations is None:
        what = "no rays were kept, so what moved stays in the cloud"
        return [f"{what}; map with --set occupancy.keep_rays=true to leave it out"]
    ratio = removed / max(points + removed, 1)
    if ratio <= _MUCH:
        return []
    what = f"{100 * ratio:.1f} % of the points are taken for what moved and left out"
    return [f"{what}: look at map/removed.ply; --set fusion.remove_moving=false keeps them"]


class CloudSample:
    """Keeps the first point of each cell, at most ``limit`` points: cells grow with the cloud."""

    def __init__(self, limit: int, cell_m: float) -> None:
        self._limit = limit
        self._first_cell_m = cell_m
        self._cell_m: float | None = None
        self._kept: list[PointCloud] = []

    def add(self, cloud: PointCloud) -> None:
        """Add points; all clouds are in map axes and have the same fields."""
        self._kept += [self._thinned(cloud)] if len(cloud) else []
        if sum(map(len, self._kept)) > self._limit:
            self._kept = [self._within_the_limit(join_clouds(self._kept))]

    def passing(self, tiles: Tiles) -> Iterator[PointCloud]:
        """Yield the clouds of tiles that have points, which are added."""
        for cloud in filter(len, (tile.cloud for tile in tiles)):
            self.add(cloud)
            yield cloud

    def cloud(self) -> PointCloud:
        """Return the sample."""
        return join_clouds(self._kept)

    def _within_the_limit(self, cloud: PointCloud) -> PointCloud:
        """Thin a cloud, with growing cells, until it is within the limit."""
        self._cell_m = self._cell_m or self._first_cell_m
        thinned = self._thinned(cloud)
        while len(thinned) > self._limit:
            self._cell_m *= _GROWTH
            thinned = self._thinned(thinned)
        return thinned

    def _thinned(self, cloud: PointCloud) -> PointCloud:
        if self._cell_m is None:
            return cloud
        keys = voxels.pack_keys(np.floor(cloud.xyz / self._cell_m).astype(np.int64))
        return cloud.select(np.sort(np.unique(keys, return_index=True)[1]))
