"""A map in the coordinates of a survey: where positions measured along the drive say it is."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import Any, Final

import numpy as np

from recon.core.errors import EvaluationError
from recon.core.geometry.alignment import fit_upright
from recon.core.geometry.interpolation import interpolate_poses, nearest_sorted
from recon.core.geometry.se3 import apply
from recon.core.values import Trajectory
from recon.core.values.arrays import Float64
from recon.io.files import read_table, reader
from recon.io.trajectory import read_tum
from recon.run.finished import FinishedRun

_LEAST_SPAN_M: Final = 1.0
"""Positions closer together than this say nothing of the direction of the map."""
_LONGEST_GAP_S: Final = 1.0
"""Between frames farther apart than this, nobody knows where the camera was."""
_LARGEST_MISFIT: Final = 0.01
"""Misfit, as a share of the extent of the positions, above which it is warned of."""


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
    """

    T_survey_map: Float64
    misfit_m: Float64
    span_m: float

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
            "misfit_rms_m": self.rms_m,
            "misfit_max_m": float(self.misfit_m.max()),
            "span_m": self.span_m,
            "tilt_deg": self.tilt_deg,
            "T_survey_map": self.T_survey_map.tolist(),
        }

    def warnings(self) -> list[str]:
        """Return a line if map and positions contradict each other."""
        if self.rms_m <= _LARGEST_MISFIT * self.span_m:
            return []
        apart = f"the positions are {self.rms_m:.2f} m from the path of the map (RMS)"
        return [f"{apart}: another clock, another antenna offset, or drift"]


def georeference(run: FinishedRun, survey: Survey) -> Georeference:
    """Place the map of a run so that its path runs through measured positions.

    The path is interpolated at their times. The map stays rigid, and upright where the positions
    do not say otherwise (`fit_upright`).

    Raises:
        FormatError: A file is missing or damaged.
        EvaluationError: No position was measured during the drive, or all at one place.
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
    span_m = float(np.linalg.norm(np.ptp(here[:, 1:], axis=0)))
    if span_m < _LEAST_SPAN_M:
        raise EvaluationError(
            "the positions do not say how the map is turned",
            where=survey.positions,
            got=f"{len(here)} positions within {span_m:.2f} m",
            expected=f"{_LEAST_SPAN_M:g} m or more",
        )
    R_camera_map = run.T_map_world[:3, :3].T
    antenna_camera = R_camera_map @ np.asarray(survey.antenna_m)
    T_world_camera = interpolate_poses(path, here[:, 0])
    ours = np.stack([apply(run.T_map_world @ T, antenna_camera[None])[0] for T in T_world_camera])
    T_survey_map = fit_upright(ours, here[:, 1:]).T_to_from
    misfit_m = np.linalg.norm(apply(T_survey_map, ours) - here[:, 1:], axis=1)
    return Georeference(T_survey_map, np.asarray(misfit_m), span_m)


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
