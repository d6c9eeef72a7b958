"""How high robots say that their camera is above the ground, against what the map shows of it."""

from __future__ import annotations

from copy import copy
from dataclasses import replace
from typing import Final

import numpy as np

from recon.core.text import metres
from recon.export.product import ExportContext
from recon.map.ground.surface import BIN_M, add_floors, measure_camera_height
from recon.map.sessions.placed import PlacedMap

_DOUBTED: Final = 2.0  # standard deviations between two heights, of which one is wrong then


def on_mounts(context: ExportContext) -> tuple[ExportContext, list[str]]:
    """Return the context with the height of the camera that all its robots state, and doubts of it.

    A height that is set wins over it; so does the ground that was seen, where it contradicts it.
    """
    tiles, mounts = context.placed.tiles, [one.mount for one in context.map.linked]
    ground, first = tiles.config.ground, mounts[0]
    stated = {None if one is None else one.camera_height_m for one in mounts}
    height_m = None if first is None or len(stated) > 1 else first.camera_height_m
    if first is None or height_m is None or ground.camera_height_m is not None:
        return context, []
    seen_m, sigma_m = _seen(context.placed)
    if abs(seen_m - height_m) > _DOUBTED * np.hypot(sigma_m, BIN_M):
        said = f"the camera is {metres(height_m)} above {first.base} by the robot's transforms"
        seen = f"{metres(seen_m)} ± {metres(sigma_m)} above the ground that was seen"
        return context, [f"{said}, and {seen}, which the grid follows"]
    mounted, known = copy(tiles), ground.model_copy(update={"camera_height_m": height_m})
    mounted.config = tiles.config.model_copy(update={"ground": known})
    return replace(context, placed=replace(context.placed, tiles=mounted)), []


def _seen(placed: PlacedMap) -> tuple[float, float]:
    """Return the height of the camera above what was seen below its path, and its spread.

    Both are NaN where nothing was. Errors of neighbours are alike: many are not surer than one.
    """
    tiles, drops = placed.tiles, [np.zeros(0)]
    for tile in tiles:
        area = tiles.bounds(tile.key)
        if len(path_m := area.path(placed.path_m)):
            points = add_floors(tiles.cloud_in(area), tiles.floors_in(area))
            reach_m = tiles.config.occupancy.max_range_m
            drops.append(measure_camera_height(points, path_m, reach_m)[1])
    drops_m = np.concatenate(drops)
    if not len(drops_m):
        return np.nan, np.nan
    middle_m = float(np.median(drops_m))
    return middle_m, 1.4826 * float(np.median(np.abs(drops_m - middle_m)))
