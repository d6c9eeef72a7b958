"""Where a robot can drive, as a costmap: what its steps, slopes and overhangs are, and how sure."""

from __future__ import annotations

import numpy as np

from recon.core.errors import MappingError
from recon.core.values import FREE, OCCUPIED, UNKNOWN, OccupancyGrid
from recon.core.values.arrays import Bool, Int32
from recon.export.occupancy import Flattening
from recon.export.product import Made, Order
from recon.io.models.nav2 import write_nav2_costs
from recon.map.ground.surface import GroundSurface
from recon.map.ground.traverse import (
    UNSURE,
    Raster,
    costs,
    judge,
    measure_relief,
    widened,
)
from recon.map.map import Map
from recon.map.occupancy.bodies import Looks
from recon.map.sessions.placed import PlacedMap


def costmap_product(order: Order) -> Made:
    """Write ``map/costmap.*``: Nav2's mode ``scale``."""
    grid, warnings = make_costmap(order.map, order.placed)
    write_nav2_costs(order.run.path("map/costmap"), grid)
    named = {"free": FREE, "lethal": OCCUPIED, "unseen": UNKNOWN, "uncertain": UNSURE}
    figures = {f"costmap_{name}_cells": int((grid.cells == v).sum()) for name, v in named.items()}
    return Made(figures, warnings, grid)


def make_costmap(map_: Map, placed: PlacedMap) -> tuple[OccupancyGrid, tuple[str, ...]]:
    """Return costs of the middle of the robot of the settings, and what a user should know.

    Raises:
        MappingError: A drive kept no rays, or the robot is lower than what counts as ground.
    """
    robot, settings = placed.tiles.config.robot, placed.tiles.config.grid
    if placed.tiles.looks is None:
        hint = "map the drive with occupancy.keep_rays=true"
        raise MappingError("a costmap is made of rays, and a drive kept none", hint=hint)
    if robot.clearance_m <= settings.min_height_m:
        raise MappingError(
            "the robot is not higher than what may be ground",
            got=f"robot.clearance_m={robot.clearance_m:g}",
            expected=f"more than grid.min_height_m={settings.min_height_m:g}",
            hint="set both; a lower band takes smaller cells (occupancy.resolution_m)",
        )
    settings = settings.model_copy(update={"max_height_m": robot.clearance_m})
    focal_px = min(session.camera.focal_px for session in map_.linked)
    finish = _Costs(placed, placed.tiles.looks, focal_px)
    grid, _, warnings = Flattening(placed, settings, finish).grid()
    return grid, warnings


class _Costs:
    """Makes costs of a tile of its grid."""

    def __init__(self, placed: PlacedMap, looks: Looks, focal_px: float) -> None:
        self._config, self._looks, self._focal_px = placed.tiles.config, looks, focal_px

    def __call__(self, grid: OccupancyGrid, ground: GroundSurface, passed: Int32) -> OccupancyGrid:
        robot, raster = (
            self._config.robot,
            Raster(grid.origin_m, grid.resolution_m, grid.cells.shape),
        )
        low = np.array(grid.origin_m)
        high = low + np.array(grid.cells.shape[::-1]) * grid.resolution_m
        frames = self._looks.near(low, high)
        most_m = self._config.grid.min_height_m
        relief = measure_relief(frames, ground, raster, most_m, self._focal_px)
        steps, slopes = judge(relief, robot)
        cells = costs(relief, steps, slopes, robot, grid)
        return widened(cells, robot, _driven(passed, raster))


def _driven(passed: Int32, raster: Raster) -> Bool:
    """Return the cells (rows, columns) of voxels (N, 3)."""
    cell, inside = raster.cells_of((passed[:, :2].astype(np.float64) + 0.5) * raster.cell_m)
    driven = np.zeros(raster.shape, np.bool_)
    driven.ravel()[cell[inside]] = True
    return driven
