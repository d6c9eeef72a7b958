"""Where a map lies in the coordinates of a survey."""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import Any, Final

import numpy as np

from recon.core.geometry.alignment import fit_points
from recon.core.geometry.se3 import apply
from recon.core.values.arrays import Float64
from recon.io.models.las import check_inside
from recon.map.map import Map
from recon.map.sessions.measured import LARGEST_MISFIT, Survey, measure_along, span_m

_LARGEST_YAW_RAD: Final = 0.1  # sigma that is said: places are off by a tenth of their distance
_LARGEST_STRETCH: Final = 0.05  # by how much the path may be too long or short before it is said


@dataclass(frozen=True, eq=False)
class Georeference:
    """Where a map is in the coordinates of a survey."""

    T_survey_map: Float64  # (4, 4), rigid
    system: str | None  # the coordinate system; None = not known
    misfit_m: Float64  # (N,), distances of the measured positions from those of the map
    span_m: float  # diagonal of the box around the positions
    scale: float  # how many times as far apart the positions are as those of the map
    left_out: int  # number of positions that contradict the others
    lines: tuple[str, ...]  # warnings that name them
    turn_rad: tuple[float, float]  # of `fixed_turn`
    reach_m: float  # from the middle of the positions to the farthest frame of the map
    points: Mapping[str, Any] = field(default_factory=dict)  # figures of each control point

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
            "yaw_sigma_deg": math.degrees(self.turn_rad[0]),
            "rotation_sigma_deg": math.degrees(self.turn_rad[1]),
            "edge_sigma_m": self.turn_rad[1] * self.reach_m,
            "T_survey_map": self.T_survey_map.tolist(),
            **({"control": dict(self.points)} if self.points else {}),
        }

    def warnings(self) -> list[str]:
        """Return lines of what is left out, and of map and positions that differ."""
        lines, yaw_rad = list(self.lines), self.turn_rad[0]
        if yaw_rad > _LARGEST_YAW_RAD:
            far = f"{yaw_rad * self.reach_m:.2g} m at its farthest frame"
            lines.append(
                f"the map is turned by an angle known to {math.degrees(yaw_rad):.1f} deg, {far}"
            )
        if self.rms_m <= LARGEST_MISFIT * self.span_m:
            return lines
        if self.points:
            return [*lines, f"the control points are {self.rms_m:.2f} m from the map (RMS)"]
        apart = f"the positions are {self.rms_m:.2f} m from the path of the map (RMS)"
        if abs(self.scale - 1.0) > _LARGEST_STRETCH:
            return [*lines, f"{apart}, {self.scale:.2f} times as far apart: not in metres?"]
        return [*lines, f"{apart}: another clock, another antenna offset, or drift"]


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
        survey.system,
        np.linalg.norm(measured.misfit_m[agree], axis=1),
        span_m(position_m),
        fit_points(ours_m, position_m, scaled=True).scale,
        len(agree) - len(ours_m),
        (*survey.notes(), *measured.warnings()),
        measured.turn_rad,
        reach_m(map_, ours_m),
    )


def reach_m(map_: Map, places_m: Float64) -> float:
    """Return how far the frames of a map are from the middle of places (N, 3) in it, at most."""
    paths = [apply(one.T_map_world, one.trajectory.positions_m) for one in map_.linked]
    return float(np.linalg.norm(np.concatenate(paths) - places_m.mean(axis=0), axis=1).max())
