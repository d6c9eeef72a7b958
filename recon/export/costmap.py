"""Where a robot can drive: costmap of steps, slopes and overhangs, and layers for ``grid_map``."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from recon.core.errors import MappingError
from recon.core.geometry.se3 import make_transform
from recon.core.values import FREE, OCCUPIED, UNKNOWN, OccupancyGrid
from recon.core.values.arrays import Float64, Int32
from recon.export.occupancy import Flattening
from recon.export.product import ExportContext, ExportResult, ProductFigures
from recon.export.rasters import ground_slopes
from recon.io.models.rasters import write_nav2_costs
from recon.io.ros.bag import write_bag
from recon.io.ros.messages import Message, header, pose
from recon.map.ground.surface import GroundSurface, Raster
from recon.map.ground.traverse import UNSURE, costs, judge, measure_relief, widened
from recon.map.map import Map
from recon.map.sessions.placed import PlacedMap


@dataclass(frozen=True)
class CostmapFigures(ProductFigures):
    """How many cells of a costmap are of each kind."""

    costmap_free_cells: int
    costmap_lethal_cells: int
    costmap_unseen_cells: int
    costmap_uncertain_cells: int

    @property
    def text(self) -> str:
        return f"{self.costmap_free_cells:,} cells free, {self.costmap_lethal_cells:,} lethal"


def costmap_product(context: ExportContext, path: Path) -> ExportResult:
    """Write costs in Nav2's mode ``scale``, given the path of their YAML file."""
    grid, warnings = make_costmap(context.map, context.placed)
    write_nav2_costs(path.with_suffix(""), grid)
    counts = (int((grid.cells == value).sum()) for value in (FREE, OCCUPIED, UNKNOWN, UNSURE))
    return ExportResult(CostmapFigures(*counts), warnings, grid)


def make_costmap(map_: Map, placed: PlacedMap) -> tuple[OccupancyGrid, tuple[str, ...]]:
    """Return costs of the middle of the robot of the settings, and what a user should know.

    Raises:
        MappingError: A drive kept no rays, the robot is wider than a tile, or the band of heights
            (`GridSettings`) is empty.
    """
    config, observations = placed.tiles.config, placed.tiles.observations
    robot, band = config.robot, config.grid
    if observations is None:
        hint = "map the drive with occupancy.keep_rays=true"
        raise MappingError("a costmap is made of rays, and a drive kept none", hint=hint)
    if robot.width_m > (tile_m := config.submaps.tile_m):
        raise MappingError(
            "the robot is wider than a tile of the map",
            got=f"robot.width_m={robot.width_m:g}",
            expected=f"at most submaps.tile_m={tile_m:g}",
            hint="set robot.width_m to that of the robot, or map with larger tiles",
        )
    seen = steep = 0
    focal_px = min(session.camera.focal_px for session in map_.linked)

    def finish(grid: OccupancyGrid, ground: GroundSurface, passed: Int32) -> OccupancyGrid:
        raster = Raster(grid.origin_m, grid.resolution_m, grid.cells.shape)
        low, size = np.array(grid.origin_m), np.array(grid.cells.shape[::-1])
        frames = observations.near(low, low + size * grid.resolution_m)
        relief = measure_relief(frames, ground, raster, band.min_height_m, focal_px)
        steps, slopes = judge(relief, robot)
        nonlocal seen, steep
        # Where noise alone does not reach the limit.
        known = np.isfinite(relief.height_m) & (slopes.sigma < 0.5)
        seen += int(known.sum())
        steep += int((slopes.value[known] > robot.max_slope_percent / 100).sum())
        cell, inside = raster.cells_of((passed[:, :2].astype(np.float64) + 0.5) * raster.cell_m)
        driven = np.zeros(raster.shape, np.bool_)
        driven.ravel()[cell[inside]] = True
        return widened(*costs(relief, steps, slopes, robot, grid), robot, driven)

    grid, _, warnings = Flattening(placed, band, finish).grid()
    if 2 * steep > seen:
        ratio, limit = f"{100 * steep / seen:.0f} %", f"{robot.max_slope_percent:g}"
        level = "is the map level (z up)? An inertial unit levels it"
        text = (
            f"{ratio} of the ground seen is steeper than robot.max_slope_percent={limit}: {level}"
        )
        warnings = (*warnings, text)
    return grid, (*map_.first.level.warnings, *warnings)


@dataclass(frozen=True)
class GridMapFigures(ProductFigures):
    """A grid map."""

    gridmap_layers: Sequence[str]

    @property
    def text(self) -> str:
        return ", ".join(self.gridmap_layers)


def gridmap_product(context: ExportContext, folder: Path) -> ExportResult:
    """Write a folder with a bag of one message: height and slope of the ground, and cells.

    Layers are ``elevation`` [m] and ``slope`` [rad] of the ground in the middle of a cell,
    ``occupancy`` (0 to 100) of the flat grid, and ``traversability`` (1 to 0) by the costs of the
    robot of the settings; NaN = unknown.
    """
    flat, _, _ = Flattening(context.placed).grid()
    costs, warnings = make_costmap(context.map, context.placed)
    heights, slopes = np.full((2, *flat.cells.shape), np.nan)
    x_m, y_m = (
        origin_m + (np.arange(cells) + 0.5) * flat.resolution_m
        for origin_m, cells in zip(flat.origin_m, flat.cells.shape[::-1], strict=True)
    )
    for bounds, ground in Flattening(context.placed).grounds():
        sides = zip((y_m, x_m), bounds.low[::-1], bounds.high[::-1], strict=True)
        part = tuple(slice(*np.searchsorted(at_m, ends_m)) for at_m, *ends_m in sides)
        xy_m = np.stack(np.meshgrid(x_m[part[1]], y_m[part[0]]), axis=-1)
        for layer, measure in ((heights, GroundSurface.height_at), (slopes, ground_slopes)):
            layer[part] = measure(ground, xy_m.reshape(-1, 2)).reshape(xy_m.shape[:2])
    layers = {
        "elevation": heights,
        "slope": slopes,
        "occupancy": _known(flat),
        "traversability": 1.0 - _known(costs) / 100.0,
    }
    time_ns = round(1e9 * float(context.map.first.trajectory.timestamps_s[0]))
    with write_bag(folder) as bag:
        bag.write("/grid_map", time_ns, _message(time_ns, flat, layers), kept=True)
    return ExportResult(GridMapFigures([*layers]), warnings)


def _known(grid: OccupancyGrid) -> Float64:
    return np.where(grid.cells < 0, np.nan, grid.cells.astype(np.float64))


def _message(time_ns: int, grid: OccupancyGrid, layers: dict[str, Float64]) -> Message:
    """Return a message, in which the first cell is the farthest forward (x) and left (y)."""
    length_m = np.array(grid.cells.shape[::-1]) * grid.resolution_m
    middle = make_transform(np.eye(3), np.array([*(grid.origin_m + length_m / 2), 0.0]))
    y_cells, x_cells = grid.cells.shape
    sides = ("column_index", y_cells, grid.cells.size), ("row_index", x_cells, x_cells)
    dim = [dict(zip(("label", "size", "stride"), side, strict=True)) for side in sides]
    data = [np.ascontiguousarray(one[::-1, ::-1], np.float32).ravel() for one in layers.values()]
    return "grid_map_msgs/msg/GridMap", {
        "header": header("map", time_ns),
        "info": {
            "resolution": grid.resolution_m,
            "length_x": float(length_m[0]),
            "length_y": float(length_m[1]),
            "pose": pose(middle),
        },
        "layers": [*layers],
        "basic_layers": ["elevation"],
        "data": [{"layout": {"dim": dim}, "data": values} for values in data],
    }
