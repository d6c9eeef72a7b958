"""The cloud of a map as files for surveying programs, perhaps in the coordinates of a survey."""

from __future__ import annotations

import math
from collections.abc import Callable
from pathlib import Path

import numpy as np

from recon.core.values import PointCloud
from recon.core.values.arrays import Bool
from recon.export.occupancy import GROUND_RATIO, grounds
from recon.export.product import ExportContext, ExportResult, PointFigures
from recon.io.models.copc import write_copc
from recon.io.models.e57 import write_e57
from recon.io.models.las import AreGround, write_las
from recon.map.ground.surface import MAX_TILT_DEG, WINDOW_M, GroundSurface
from recon.map.sessions.placed import PlacedMap


def las_product(
    context: ExportContext, path: Path, write: Callable[..., int] = write_las
) -> ExportResult:
    """Write the cloud as LAS or LAZ, with the ground as a class, perhaps where a survey says."""
    clouds = (tile.cloud for tile in context.placed.tiles)
    # A hundredth of a voxel, as a decimal: a millimetre on a road.
    step_m = 10.0 ** math.floor(math.log10(context.placed.tiles.config.fusion.voxel_m) - 2.0)
    how = {"step_m": step_m, "ground": _ground_of(context.placed)}
    return ExportResult(PointFigures(write(path, clouds, context.T_survey_map, context.crs, **how)))


def copc_product(context: ExportContext, path: Path) -> ExportResult:
    """Write the cloud as COPC, as `las_product` does."""
    return las_product(context, path, write_copc)


def e57_product(context: ExportContext, path: Path) -> ExportResult:
    """Write the cloud as E57, perhaps where a survey says."""
    clouds = (tile.cloud for tile in context.placed.tiles)
    return ExportResult(PointFigures(write_e57(path, clouds, context.T_survey_map, context.crs)))


def _ground_of(placed: PlacedMap) -> AreGround:
    """Return what tells which points of a tile are ground; far from the path, none is known."""
    tiles, known = placed.tiles, dict(grounds(placed))

    def are_ground(cloud: PointCloud) -> Bool:
        if not len(cloud):
            return np.zeros(0, np.bool_)
        column, row = (cloud.xyz[0, :2] // tiles.edge_m).astype(int).tolist()
        surface = known.get(tiles.bounds((column, row)))
        return np.zeros(len(cloud), np.bool_) if surface is None else ground_points(cloud, surface)

    return are_ground


def ground_points(cloud: PointCloud, surface: GroundSurface) -> Bool:
    """Return bool (N,), which points lie on a surface and, if normals are known, face up.

    Nothing but ground lies below it: as far as that is seen too low, it is seen too high elsewhere.
    """
    above_m = cloud.xyz[:, 2] - surface.height_at(cloud.xyz[:, :2])
    below_m = -above_m[(above_m <= 0) & (above_m >= -WINDOW_M)]
    thick_m = float(np.quantile(below_m, GROUND_RATIO)) if len(below_m) else 0.0
    on = np.abs(above_m) <= thick_m  # not where the surface is unknown
    if cloud.normals is not None:
        on &= cloud.normals[:, 2] >= math.cos(math.radians(MAX_TILT_DEG))
    return np.asarray(on)
