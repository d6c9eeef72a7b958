"""A map in the coordinates of a survey: where positions measured along the drive say it is."""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass
from typing import Any, Final

import numpy as np

from recon.core.geometry.alignment import fit_points
from recon.core.values.arrays import Float64
from recon.export.product import Made, Order
from recon.io.models.copc import write_copc
from recon.io.models.e57 import write_e57
from recon.io.models.las import check_inside, write_las
from recon.map.map import Map
from recon.map.sessions.measured import LARGEST_MISFIT, Survey, measure_along, span_m

_LARGEST_STRETCH: Final = 0.05  # by how much the path may be too long or short before it is said


@dataclass(frozen=True, eq=False)
class Georeference:
    """Where a map is in the coordinates of a survey."""

    T_survey_map: Float64  # (4, 4), rigid
    misfit_m: Float64  # (N,), distances of the measured positions from those of the map
    span_m: float  # diagonal of the box around the positions
    scale: float  # how many times as far apart the positions are as those of the map
    left_out: int  # number of positions that contradict the others
    lines: tuple[str, ...]  # warnings that name them

    @property
    def rms_m(self) -> float:
        """Root mean square of the distances."""
        return float(np.sqrt(np.mean(self.misfit_m**2)))

    @property
    def tilt_deg(self) -> float:
        """Angle between the map's up and that of the survey."""
        return float(np.degrees(np.arccos(min(1.0, self.T_survey_map[2, 2]))))

    def figures(self) -> dict[str, Any]:
        """Return the figures of ``summary.json``."""
        return {
            "positions": len(self.misfit_m),
            "positions_left_out": self.left_out,
            "misfit_rms_m": self.rms_m,
            "misfit_max_m": float(self.misfit_m.max()),
            "span_m": self.span_m,
            "scale": self.scale,
            "tilt_deg": self.tilt_deg,
            "T_survey_map": self.T_survey_map.tolist(),
        }

    def warnings(self) -> list[str]:
        """Return lines of what is left out, and of map and positions that differ."""
        lines = list(self.lines)
        if self.rms_m <= LARGEST_MISFIT * self.span_m:
            return lines
        apart = f"the positions are {self.rms_m:.2f} m from the path of the map (RMS)"
        if abs(self.scale - 1.0) > _LARGEST_STRETCH:
            return [*lines, f"{apart}, {self.scale:.2f} times as far apart: not in metres?"]
        return [*lines, f"{apart}: another clock, another antenna offset, or drift"]


def survey_product(suffix: str) -> Callable[[Order], Made]:
    """Return what writes ``map/cloud.`` and a suffix, perhaps where a survey says."""
    write_points = write_copc if suffix.startswith("copc") else write_las

    def write(order: Order) -> Made:
        T_file_map, figures, warnings = placed_in_survey(order)
        clouds = (tile.cloud for tile in order.placed.tiles)
        path = order.run.path(f"map/cloud.{suffix}")
        crs = None if order.survey is None else order.survey.system
        if suffix == "e57":
            points = write_e57(path, clouds, T_file_map, crs)
        else:
            # A hundredth of a voxel, as a decimal: a millimetre on a road.
            step_m = 10.0 ** math.floor(math.log10(order.placed.tiles.config.fusion.voxel_m) - 2.0)
            points = write_points(path, clouds, T_file_map, crs, step_m=step_m)
        return Made({**figures, "points": points}, warnings)

    return write


def placed_in_survey(order: Order) -> tuple[Float64, dict[str, Any], list[str]]:
    """Return how map axes become those of a file (4, 4), figures of that, and warnings."""
    if order.survey is None:
        return np.eye(4), {}, []
    placed = georeference(order.map, order.survey)
    return placed.T_survey_map, placed.figures(), placed.warnings()


def georeference(map_: Map, survey: Survey) -> Georeference:
    """Place a map so that the path of the drive that began it runs through measured positions.

    The map stays rigid, and upright where the positions do not say otherwise (`fit_upright`);
    positions that contradict most others are left out.
    """
    measured = measure_along(map_.first, survey)
    if survey.system is not None:
        check_inside(survey.system, np.median(measured.position_m, axis=0), survey.positions)
    agree = measured.agree
    ours_m, position_m = measured.ours_m[agree], measured.position_m[agree]
    return Georeference(
        measured.T_survey_map,
        np.linalg.norm(measured.misfit_m[agree], axis=1),
        span_m(position_m),
        fit_points(ours_m, position_m, scaled=True).scale,
        len(agree) - len(ours_m),
        (*survey.notes(), *measured.warnings()),
    )
