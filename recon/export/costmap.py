"""Where a robot can drive, as a costmap: what its steps, slopes and overhangs are, and how sure."""

from __future__ import annotations

from pathlib import Path

import numpy as np

from recon.core.errors import MappingError
from recon.core.values import FREE, OCCUPIED, UNKNOWN, OccupancyGrid
from recon.core.values.arrays import Int32
from recon.export.occupancy import Flattening
from recon.export.product import ExportContext, ExportResult
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
from recon.map.sessions.placed import PlacedMap


def costmap_product(context: ExportContext, path: Path) -> ExportResult:
    """Write costs in Nav2's mode ``scale``, given the path of their YAML file."""
    grid, warnings = make_costmap(context.map, context.placed)
    write_nav2_costs(path.with_suffix(""), grid)
    named = {"free": FREE, "lethal": OCCUPIED, "unseen": UNKNOWN, "uncertain": UNSURE}
    figures = {f"costmap_{name}_cells": int((grid.cells == v).sum()) for name, v in named.items()}
    return ExportResult(figures, warnings, grid)


def make_costmap(map_: Map, placed: PlacedMap) -> tuple[OccupancyGrid, tuple[str, ...]]:
    """Return costs of the middle of the robot of the settings, and what a user should know.

    Raises:
        MappingError: A drive kept no rays, the robot is wider than a tile, or the band of heights
            (`GridSettings`) is empty.
    """
    robot, band, observations = (
        placed.tiles.config.robot,
        placed.tiles.config.grid,
        placed.tiles.observations,
    )
    if observations is None:
        hint = "map the drive with occupancy.keep_rays=true"
        raise MappingError("a costmap is made of rays, and a drive kept none", hint=hint)
    if robot.width_m > (tile_m := placed.tiles.config.submaps.tile_m):
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
        return widened(costs(relief, steps, slopes, robot, grid), robot, driven)

    grid, _, warnings = Flattening(placed, band, finish).grid()
    if 2 * steep > seen:
        ratio, limit = f"{100 * steep / seen:.0f} %", f"{robot.max_slope_percent:g}"
        level = "is the map level (z up)? An inertial unit levels it"
        text = (
            f"{ratio} of the ground seen is steeper than robot.max_slope_percent={limit}: {level}"
        )
        warnings = (*warnings, text)
    return grid, warnings
