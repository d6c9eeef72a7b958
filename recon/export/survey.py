"""A map in the coordinates of a survey: where positions measured along the drive say it is."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import Any, Final

import numpy as np

from recon.core.errors import EvaluationError
from recon.core.geometry.alignment import find_agreeing, fit_points, fit_upright
from recon.core.geometry.interpolation import interpolate_poses, nearest_sorted
from recon.core.geometry.se3 import apply
from recon.core.values import Trajectory
from recon.core.values.arrays import Float64
from recon.io.files import read_table, reader
from recon.io.models.las import check_inside
from recon.io.trajectory import read_tum
from recon.run.finished import FinishedRun

_LEAST_SPAN_M: Final = 1.0
"""Positions closer together than this say nothing of the direction of the map."""
_LONGEST_GAP_S: Final = 1.0
"""Between frames farther apart than this, nobody knows where the camera was."""
_LARGEST_MISFIT: Final = 0.01
"""Misfit, as a share of the extent of the path, that drift may explain."""
_LARGEST_STRETCH: Final = 0.05
"""By how much the path may be too long or short; more is another unit."""
_NAMED: Final = 3


@dataclass(frozen=True)
class Survey:
    """Positions along a drive in the coordinates of a survey.

    Attributes:
        positions: File with rows of time in seconds, easting, northing and height in metres (or a
            TUM file), on the clock of the images.
        antenna_m: Where what they are the positions of (antenna, prism) is, from the left camera:
            metres forward, left and up.
        crs: Name of the coordinate system, such as ``EPSG:25832``; None = not stated.
    """

    positions: Path
    antenna_m: tuple[float, float, float] = (0.0, 0.0, 0.0)
    crs: str | None = None


@dataclass(frozen=True, eq=False)
class Georeference:
    """Where a map is in the coordinates of a survey.

    Attributes:
        T_survey_map: float64 (4, 4), rigid.
        misfit_m: float64 (N,), distances of the measured positions from those of the map.
        span_m: Diagonal of the box around the positions.
        scale: How many times as far apart the positions are as those of the map.
        left_out: float64 (K, 2), time in seconds and distance in metres of positions that
            contradict the others.
    """

    T_survey_map: Float64
    misfit_m: Float64
    span_m: float
    scale: float
    left_out: Float64

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
            "positions_left_out": len(self.left_out),
            "misfit_rms_m": self.rms_m,
            "misfit_max_m": float(self.misfit_m.max()),
            "span_m": self.span_m,
            "scale": self.scale,
            "tilt_deg": self.tilt_deg,
            "T_survey_map": self.T_survey_map.tolist(),
        }

    def warnings(self) -> list[str]:
        """Return lines of what is left out, and of map and positions that differ."""
        lines = [] if not len(self.left_out) else [self._left_out_line()]
        if self.rms_m <= _LARGEST_MISFIT * self.span_m:
            return lines
        apart = f"the positions are {self.rms_m:.2f} m from the path of the map (RMS)"
        if abs(self.scale - 1.0) > _LARGEST_STRETCH:
            return [*lines, f"{apart}, {self.scale:.2f} times as far apart: not in metres?"]
        return [*lines, f"{apart}: another clock, another antenna offset, or drift"]

    def _left_out_line(self) -> str:
        worst = self.left_out[np.argsort(-self.left_out[:, 1])][:_NAMED]
        named = ", ".join(f"at {time_s:.3f} s ({off_m:.1f} m off)" for time_s, off_m in worst)
        more = ", …" if len(self.left_out) > _NAMED else ""
        of_all = f"{len(self.left_out)} of {len(self.left_out) + len(self.misfit_m)} positions"
        return f"{of_all} contradict the others and are left out: {named}{more}"


def georeference(run: FinishedRun, survey: Survey) -> Georeference:
    """Place the map of a run so that its path runs through measured positions.

    The path is interpolated at their times. The map stays rigid, and upright where the positions
    do not say otherwise (`fit_upright`); positions that contradict most others are left out.

    Raises:
        FormatError: A file is missing or damaged.
        EvaluationError: No position was measured during the drive, all at one place, or they lie
            outside their coordinate system.
    """
    path = _path_of(run)
    measured = _read_positions(survey.positions)
    here = measured[_during(path, measured[:, 0])]
    if not len(here):
        raise EvaluationError(
            "no position was measured during the drive",
            where=survey.positions,
            got=f"times {measured[0, 0]:.3f} to {measured[-1, 0]:.3f} s",
            expected=f"times within {path.timestamps_s[0]:.3f} to {path.timestamps_s[-1]:.3f} s",
            hint="both need one clock",
        )
    if survey.crs is not None:
        check_inside(survey.crs, np.median(here[:, 1:], axis=0), survey.positions)
    if _span_m(here[:, 1:]) < _LEAST_SPAN_M:
        raise EvaluationError(
            "the positions do not say how the map is turned",
            where=survey.positions,
            got=f"{len(here)} positions within {_span_m(here[:, 1:]):.2f} m",
            expected=f"{_LEAST_SPAN_M:g} m or more",
        )
    R_camera_map = run.T_map_world[:3, :3].T
    antenna_camera = R_camera_map @ np.asarray(survey.antenna_m)
    T_world_camera = interpolate_poses(path, here[:, 0])
    ours = np.stack([apply(run.T_map_world @ T, antenna_camera[None])[0] for T in T_world_camera])
    return _fit(ours, here)


def _fit(ours: Float64, here: Float64) -> Georeference:
    """Return where positions in the map (N, 3) are, by rows of time and position (N, 4)."""
    span_m = _span_m(ours)
    agree = find_agreeing(ours, here[:, 1:], _LARGEST_MISFIT * span_m)
    T_survey_map = fit_upright(ours[agree], here[agree, 1:]).T_to_from
    misfit_m = np.linalg.norm(apply(T_survey_map, ours) - here[:, 1:], axis=1)
    return Georeference(
        T_survey_map,
        np.asarray(misfit_m[agree]),
        _span_m(here[agree, 1:]),
        fit_points(ours[agree], here[agree, 1:], scaled=True).scale,
        np.column_stack([here[:, 0], misfit_m])[~agree],
    )


def _span_m(positions: Float64) -> float:
    """Return the diagonal of the box around positions (N, 3)."""
    return float(np.linalg.norm(np.ptp(positions, axis=0)))


def _path_of(run: FinishedRun) -> Trajectory:
    """Return the path of the drive that began the map, without frames that are not trusted."""
    whole = run.folder / "trajectory_tum.txt"
    if not whole.is_file():
        return read_tum(run.folder / "sessions/0/trajectory_tum.txt")
    path = read_tum(whole)
    trusted = np.ones(len(path), np.bool_)
    trusted[[n for n in run.untrusted if n < len(path)]] = False
    return Trajectory(path.T_world_camera[trusted], path.timestamps_s[trusted])


@reader
def _read_positions(file: Path) -> Float64:
    """Return time, east, north and up (N, 4), in the order of time."""
    table, _ = read_table(file, (4, 8))
    return np.asarray(table[np.argsort(table[:, 0], kind="stable"), :4])


def _during(path: Trajectory, times_s: Float64) -> Float64:
    """Return bool (N,): times between two frames of a path that follow each other."""
    frames_s = path.timestamps_s
    inside = (times_s >= frames_s[0]) & (times_s <= frames_s[-1])
    near_s = np.abs(frames_s[nearest_sorted(times_s, frames_s)] - times_s)
    return np.asarray(inside & (near_s <= 0.5 * _LONGEST_GAP_S))
