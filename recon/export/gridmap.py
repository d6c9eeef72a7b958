"""The layers of a map in one message of the ROS package ``grid_map``."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from recon.core.geometry.se3 import make_transform
from recon.core.values import OccupancyGrid
from recon.core.values.arrays import Float64
from recon.export.costmap import make_costmap
from recon.export.occupancy import grounds, make_grid
from recon.export.product import ExportContext, ExportResult, ProductFigures
from recon.export.rasters import ground_slopes
from recon.io.models.ros_bag import Message, header, pose, write_bag
from recon.map.ground.surface import GroundSurface


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
    flat, _, _ = make_grid(context.placed)
    costs, warnings = make_costmap(context.map, context.placed)
    heights, slopes = np.full((2, *flat.cells.shape), np.nan)
    x_m, y_m = (
        origin_m + (np.arange(cells) + 0.5) * flat.resolution_m
        for origin_m, cells in zip(flat.origin_m, flat.cells.shape[::-1], strict=True)
    )
    for bounds, ground in grounds(context.placed):
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
