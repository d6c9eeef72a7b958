"""The cloud of a map as files for surveying programs, perhaps in the coordinates of a survey."""

from __future__ import annotations

import math
from collections.abc import Callable

from recon.export.product import Made, Order
from recon.io.models.copc import write_copc
from recon.io.models.e57 import write_e57
from recon.io.models.las import write_las


def survey_product(suffix: str) -> Callable[[Order], Made]:
    """Return what writes ``map/cloud.`` and a suffix, perhaps where a survey says."""
    write_points = write_copc if suffix.startswith("copc") else write_las

    def write(order: Order) -> Made:
        T_file_map = order.T_survey_map
        clouds = (tile.cloud for tile in order.placed.tiles)
        path = order.run.path(f"map/cloud.{suffix}")
        if suffix == "e57":
            points = write_e57(path, clouds, T_file_map, order.crs)
        else:
            # A hundredth of a voxel, as a decimal: a millimetre on a road.
            step_m = 10.0 ** math.floor(math.log10(order.placed.tiles.config.fusion.voxel_m) - 2.0)
            points = write_points(path, clouds, T_file_map, order.crs, step_m=step_m)
        return Made({"points": points})

    return write
