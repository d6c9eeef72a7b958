"""Where a map lies in the coordinates of a survey."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from typing import Final

import numpy as np

from recon.core.geometry.alignment import fit_points
from recon.core.geometry.se3 import apply
from recon.core.summary import Figures, optional
from recon.core.text import metres
from recon.core.values.arrays import Float64
from recon.io.models.las import check_inside
from recon.map.map import Map
from recon.map.sessions.measured import LARGEST_MISFIT, Survey, measure_along, span_m

_LARGEST_YAW_RAD: Final = 0.1  # sigma that is said: places are off by a tenth of their distance
_LARGEST_STRETCH: Final = 0.05  # by how much the path may be too long or short before it is said


@dataclass(frozen=True)
class ControlFigures(Figures):
    """How far the map is off a control point, map minus survey, and what was expected.

    NaN (None in JSON) where no image shows how far away it is.
    """

    east_m: float
    north_m: float
    up_m: float
    sigma_east_m: float  # standard deviations that were expected
    sigma_north_m: float
    sigma_up_m: float
    sigma_m: float  # in the direction that is known worst
    images: Sequence[str]  # in which it was measured
    used: bool  # whether it places the map
    check: bool  # whether it only compares
    note: str = ""  # why it is left out, or that it is farther off than expected


@dataclass(frozen=True, kw_only=True, eq=False)
class SurveyFigures(Figures):
    """How a map lies in the coordinates of a survey."""

    positions: int
    positions_left_out: int
    misfit_rms_m: float
    misfit_max_m: float
    span_m: float  # diagonal of the box around the positions
    scale: float  # distances between positions, divided by those in the map
    tilt_deg: float
    yaw_sigma_deg: float
    rotation_sigma_deg: float  # about the axis that is known worst
    edge_sigma_m: float  # of that frame of the map which the rotation moves most
    T_survey_map: Float64  # (4, 4), rigid
    control: Mapping[str, ControlFigures] | None = optional()  # by name of the control point


@dataclass(frozen=True, eq=False)
class Georeference:
    """Where a map is in the coordinates of a survey."""

    T_survey_map: Float64  # (4, 4), rigid
    system: str | None  # the coordinate system; None = not known
    off_m: Float64  # (N, 3), of the map from the measured positions: east, north and up
    span_m: float  # diagonal of the box around the positions
    scale: float  # how many times as far apart the positions are as those of the map
    left_out: int  # number of positions that contradict the others
    lines: tuple[str, ...]  # warnings that name them
    turn: Float64  # (3, 3), rad², of `fixed_turn`
    edge_m: float  # by which it moves the frame of the map that it moves most, sigma
    middle_m: Float64  # (3,), about which the map is turned
    shift_m: float  # standard deviation of its coordinates
    points: Mapping[str, ControlFigures] = field(default_factory=dict)

    @property
    def rms_m(self) -> float:
        return float(np.sqrt(np.mean(np.sum(self.off_m**2, axis=1))))

    @property
    def tilt_deg(self) -> float:
        """Angle between the map's up and that of the survey."""
        return float(np.degrees(np.arccos(min(1.0, self.T_survey_map[2, 2]))))

    def covariance(self, places_m: Float64) -> Float64:
        """Return (N, 3, 3), m², of places (N, 3) of a rigid map, by how well it is placed."""
        turned = _turned(self.turn, places_m - self.middle_m)
        return np.asarray(turned + self.shift_m**2 * np.eye(3))

    def figures(self) -> SurveyFigures:
        return SurveyFigures(
            positions=len(self.off_m),
            positions_left_out=self.left_out,
            misfit_rms_m=self.rms_m,
            misfit_max_m=float(np.linalg.norm(self.off_m, axis=1).max()),
            span_m=self.span_m,
            scale=self.scale,
            tilt_deg=self.tilt_deg,
            yaw_sigma_deg=math.degrees(math.sqrt(self.turn[2, 2])),
            rotation_sigma_deg=math.degrees(math.sqrt(np.linalg.eigvalsh(self.turn)[-1])),
            edge_sigma_m=self.edge_m,
            T_survey_map=self.T_survey_map,
            control=self.points or None,
        )

    def warnings(self) -> list[str]:
        """Return lines of what is left out, and of map and positions that differ."""
        lines, yaw_rad = list(self.lines), math.sqrt(self.turn[2, 2])
        if yaw_rad > _LARGEST_YAW_RAD:
            far = f"{self.edge_m:.2g} m at its farthest frame"
            lines.append(
                f"the map is turned by an angle known to {math.degrees(yaw_rad):.1f} deg, {far}"
            )
        if self.rms_m <= LARGEST_MISFIT * self.span_m:
            return lines
        if self.points:
            return [*lines, f"the control points are {metres(self.rms_m)} from the map (RMS)"]
        apart = f"the positions are {metres(self.rms_m)} from the path of the map (RMS)"
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
    agree, turn = measured.agree, np.eye(3) if measured.turn is None else measured.turn
    ours_m, position_m = measured.ours_m[agree], measured.position_m[agree]
    off_m = measured.misfit_m[agree]
    # Errors of a receiver last longer than a drive: their mean is known no better than one.
    shift_m = max(float(np.median(measured.turn_sigma_m)), float(np.sqrt(np.mean(off_m**2))))
    return Georeference(
        measured.T_survey_map,
        survey.system,
        off_m,
        span_m(position_m),
        fit_points(ours_m, position_m, scaled=True).scale,
        len(agree) - len(ours_m),
        (*survey.notes(), *measured.warnings()),
        turn,
        edge_m(map_, measured.T_survey_map, turn, position_m),
        position_m.mean(axis=0),
        shift_m,
    )


def edge_m(map_: Map, T_survey_map: Float64, turn: Float64, places_m: Float64) -> float:
    """Return by how much a rotation (3, 3) about places (N, 3) moves a frame of a map at most."""
    paths = [apply(one.T_map_world, one.trajectory.positions_m) for one in map_.linked]
    arms_m = apply(T_survey_map, np.concatenate(paths)) - places_m.mean(axis=0)
    return float(np.sqrt(np.max(np.trace(_turned(turn, arms_m), axis1=1, axis2=2))))


def _turned(turn: Float64, arms_m: Float64) -> Float64:
    """Return covariances (N, 3, 3), m², of the ends of arms (N, 3) by that of a rotation, rad²."""
    across_m = np.cross(np.eye(3), arms_m[:, None])  # by which a radian about each axis moves them
    return np.asarray(np.swapaxes(across_m, 1, 2) @ turn @ across_m)
