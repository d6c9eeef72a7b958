"""The fused cloud of a map as files, also for surveying; an even sample for images and reports."""

from __future__ import annotations

import math
from collections import deque
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Final

import numpy as np
from numpy.typing import NDArray

from recon.core.kernels import voxels
from recon.core.values import PointCloud, join_clouds
from recon.core.values.arrays import Bool, UInt8
from recon.export.occupancy import GROUND_RATIO, Flattening
from recon.export.product import ExportContext, ExportResult, PointFigures
from recon.io.models.columns import write_npz, write_pcd
from recon.io.models.las import (
    ABOVE_GROUND,
    GROUND,
    UNCLASSIFIED,
    write_copc,
    write_e57,
    write_las,
)
from recon.io.models.ply import write_ply_tiles
from recon.map.ground.surface import MAX_TILT_DEG, WINDOW_M, GroundSurface
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
        what = "no rays were kept, so dynamic objects stay in the cloud"
        return [f"{what}; map with --set occupancy.keep_rays=true to leave it out"]
    ratio = removed / max(points + removed, 1)
    if ratio <= _MUCH:
        return []
    what = f"{100 * ratio:.1f} % of the points are taken for dynamic objects and left out"
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
        if sum(map(len, self._kept)) <= self._limit:
            return
        self._cell_m = self._cell_m or self._first_cell_m
        thinned = self._thinned(join_clouds(self._kept))
        while len(thinned) > self._limit:
            self._cell_m *= _GROWTH
            thinned = self._thinned(thinned)
        self._kept = [thinned]

    def passing(self, tiles: Tiles) -> Iterator[PointCloud]:
        """Yield the clouds of tiles that have points, which are added."""
        for cloud in filter(len, (tile.cloud for tile in tiles)):
            self.add(cloud)
            yield cloud

    def cloud(self) -> PointCloud:
        return join_clouds(self._kept)

    def _thinned(self, cloud: PointCloud) -> PointCloud:
        if self._cell_m is None:
            return cloud
        keys = voxels.pack_keys(np.floor(cloud.xyz / self._cell_m).astype(np.int64))
        return cloud.select(np.sort(np.unique(keys, return_index=True)[1]))


def las_product(
    context: ExportContext, path: Path, write: Callable[..., int] = write_las
) -> ExportResult:
    """Write the cloud as LAS or LAZ with classes of points, perhaps where a survey says."""
    clouds = (tile.cloud for tile in context.placed.tiles)
    # A hundredth of a voxel, as a decimal: a millimetre on a road.
    step_m = 10.0 ** math.floor(math.log10(context.placed.tiles.config.fusion.voxel_m) - 2.0)
    tiles, known = context.placed.tiles, dict(Flattening(context.placed).grounds())

    def classify(cloud: PointCloud) -> UInt8:
        """Return the classes of points of a tile; far from the path, no ground is known."""
        if not len(cloud):
            return np.zeros(0, np.uint8)
        column, row = (cloud.xyz[0, :2] // tiles.edge_m).astype(int).tolist()
        surface = known.get(tiles.bounds((column, row)))
        if surface is None:
            return np.full(len(cloud), UNCLASSIFIED, np.uint8)
        above = cloud.xyz[:, 2] > surface.height_at(cloud.xyz[:, :2])
        classes = np.where(above, ABOVE_GROUND, UNCLASSIFIED)
        return np.where(ground_points(cloud, surface), GROUND, classes).astype(np.uint8)

    how = {"step_m": step_m, "classify": classify}
    return ExportResult(PointFigures(write(path, clouds, context.T_survey_map, context.crs, **how)))


def copc_product(context: ExportContext, path: Path) -> ExportResult:
    """Write the cloud as COPC, as `las_product` does."""
    return las_product(context, path, write_copc)


def e57_product(context: ExportContext, path: Path) -> ExportResult:
    """Write the cloud as E57, perhaps where a survey says."""
    clouds = (tile.cloud for tile in context.placed.tiles)
    return ExportResult(PointFigures(write_e57(path, clouds, context.T_survey_map, context.crs)))


def ground_points(cloud: PointCloud, surface: GroundSurface) -> Bool:
    """Return bool (N,), which points lie on a surface and, if normals are known, face up."""
    above_m = cloud.xyz[:, 2] - surface.height_at(cloud.xyz[:, :2])
    below_m = -above_m[(above_m <= 0) & (above_m >= -WINDOW_M)]
    thick_m = float(np.quantile(below_m, GROUND_RATIO)) if len(below_m) else 0.0
    on = np.abs(above_m) <= thick_m  # not where the surface is unknown
    if cloud.normals is not None:
        on &= cloud.normals[:, 2] >= math.cos(math.radians(MAX_TILT_DEG))
    return np.asarray(on)
