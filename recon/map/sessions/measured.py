"""Positions that were measured along drives, on a clock of their own, beside the paths of a map."""

from __future__ import annotations

import math
from dataclasses import dataclass, replace
from functools import cached_property
from pathlib import Path
from typing import Final

import numpy as np

from recon.core.errors import EvaluationError, ReconError, SettingsError
from recon.core.geometry.alignment import (
    find_agreeing,
    fit_upright,
    interpolate_poses,
    nearest_sorted,
    turn_covariance,
)
from recon.core.geometry.se3 import apply, invert
from recon.core.text import counted, metres
from recon.core.values import Trajectory
from recon.core.values.arrays import Bool, Float64
from recon.io.positions import ControlPoints, Positions, is_control, read_control
from recon.map.sessions.clock import LEAST_SIGMA_M, clock_error
from recon.map.store.map_file import MapFile
from recon.map.store.session import Session
from recon.odometry.health import expected_drift
from recon.places.places import RECEIVER_M, SIGMAS, drift_at_end, fit_to_path
from recon.places.pose_graph import Fixes
from recon.sources.bag import read_measured

LARGEST_MISFIT: Final = (
    0.01  # misfit, as a fraction of the extent of the path, that drift may explain
)
_LONGEST_ARM_M: Final = 100.0
"""The axes of a vehicle are known to a degree or so: an antenna farther away is off by metres."""
LEVEL_RAD: Final = np.radians(3.0)
"""Of the map's up, which is levelled where it is tilted more; standard deviation."""
_MOST_YAW_RAD: Final = 0.5 * np.pi / SIGMAS
"""A direction that is known worse may be any: its largest error is a right angle."""
_UNSTATED_M: Final = 2.0
"""What positions of unknown quality are off by together at least: two always fit a path."""
_LONGEST_GAP_S: Final = 1.0
"""Between frames farther apart than this, nobody knows where the camera was."""
_FEWEST_TO_BEND: Final = 5
_LEAST_BEND_M: Final = 0.1
"""Positions of so many places, and so far from a straight line, tell left from right."""
_NAMED: Final = 3
_SIGMA_OF_CURVATURE: Final = 1.4826 / np.sqrt(6.0)
"""Standard deviation of errors, by the median of how far they are from a line through three."""


@dataclass(frozen=True)
class Survey:
    """Positions along a drive in the coordinates of a survey.

    Attributes:
        positions: What a receiver or a total station wrote (`recon.io.positions`), a recording with
            `NavSatFix` (`recon.sources.bag`), or rows of time in seconds, easting,
            northing and height in metres (or a TUM file), on the clock of the images. One or three
            more columns are standard deviations in metres, of all coordinates or each.
        antenna_m: Where what they are the positions of (antenna, prism) is, from the left camera:
            metres forward, left and up.
        crs: Name of the coordinate system, such as ``EPSG:25832``; None = not stated: that of UTM
            where positions are latitude and longitude.
    """

    positions: Path
    antenna_m: tuple[float, float, float] = (0.0, 0.0, 0.0)
    crs: str | None = None

    def __post_init__(self) -> None:
        if not math.hypot(*self.antenna_m) <= _LONGEST_ARM_M:
            raise SettingsError(
                "the antenna is not on the vehicle of the camera",
                where="--antenna",
                got=f"{math.hypot(*self.antenna_m):.4g} m away",
                expected=f"at most {_LONGEST_ARM_M:g} m",
                hint="it is metres forward, left and up from the left camera",
            )

    @property
    def files(self) -> dict[str, Path]:
        """The files of the positions by their names, below that of their folder if it is one."""
        place = Path(str(self.positions).partition(":/")[0])  # without the name of a topic
        files = [place] if place.is_file() else sorted(filter(Path.is_file, place.rglob("*")))
        return {one.relative_to(place.parent).as_posix(): one for one in files}

    @cached_property
    def control(self) -> ControlPoints | None:
        """The control points of the file; None = it has positions of a drive."""
        if not is_control(self.positions):
            return None
        if any(self.antenna_m):
            raise SettingsError("control points have no antenna", where="--antenna")
        return read_control(self.positions, self.crs)

    @cached_property
    def found(self) -> Positions:
        """What the file has, in the order of time."""
        if self.control is not None:
            what, hint = "control points have no times", "recon export takes them"
            raise EvaluationError(what, where=self.positions, hint=hint)
        return read_measured(self.positions)

    @cached_property
    def system(self) -> str | None:
        """The coordinate system of products; None = not known."""
        return self._projected[1]

    @cached_property
    def rows(self) -> Float64:
        """float64 (N, 7), time, easting, northing, height, and sigma (or NaN) of these, metres."""
        return np.column_stack([self.found.times_s, self._projected[0], self.found.sigma_m])

    @cached_property
    def swapped_m(self) -> Float64:
        """float64 (N, 3), where positions would be with their first two columns swapped."""
        swapped = replace(self.found, places=self.found.places[:, [1, 0, 2]])
        try:
            return swapped.projected(None, self.positions)[0]
        except ReconError:  # there is no such place
            return self.rows[:, 1:4]

    def notes(self) -> list[str]:
        """Return lines of what was chosen, and of what heights are above."""
        chosen = [] if self.crs == self.system else [f"coordinates are those of {self.system}"]
        if self.found.heights:
            chosen += [f"heights are above {self.found.heights}, as the receiver has them"]
        return chosen

    @cached_property
    def _projected(self) -> tuple[Float64, str | None]:
        return self.found.projected(self.crs, self.positions)


@dataclass(frozen=True, eq=False)
class Measured:
    """Positions that were measured during a drive, in the order of time."""

    times_s: Float64
    position_m: Float64  # (N, 3), in the coordinates of the survey
    ours_m: Float64  # (N, 3), by the path, in map axes
    agree: Bool  # (N,), False for positions that contradict most others
    # float64 (N,), standard deviation of a coordinate by the file; None = it does not say
    stated_m: Float64 | None = None
    swapped_m: Float64 | None = None  # (N, 3), with easting and northing swapped
    time_offset_s: float = 0.0  # by how much their clock was late; times are those of the images
    time_offset_sigma_s: float = 0.0
    degrees: bool = False  # whether the file has latitude and longitude
    turn: Float64 | None = None  # of `fixed_turn`

    @cached_property
    def T_survey_map(self) -> Float64:
        """float64 (4, 4), rigid, by which the path runs through the positions that agree."""
        return fit_upright(self.ours_m[self.agree], self.position_m[self.agree]).T_to_from

    @property
    def misfit_m(self) -> Float64:
        """float64 (N, 3), by how much each is off then."""
        return np.asarray(apply(self.T_survey_map, self.ours_m) - self.position_m)

    @property
    def sigma_m(self) -> Float64:
        """float64 (N,), standard deviation of a coordinate, as the path is optimised by it.

        What many in a row are off by, or by more and more, cannot be told from drift of the path:
        that is for the file to say. Where it says, its own differences count.
        """
        stated_m = np.zeros(len(self.times_s)) if self.stated_m is None else self.stated_m
        typical_m = float(np.median(stated_m[self.agree])) if self.agree.any() else 0.0
        worse = max(1.0, self.uneven_m / typical_m) if typical_m > 0.0 else 1.0
        least_m = self.uneven_m if typical_m == 0.0 else 0.0
        return np.maximum(max(LEAST_SIGMA_M, least_m), worse * stated_m)

    @property
    def turn_sigma_m(self) -> Float64:
        """float64 (N,), for those that agree: as stated, else what they differ from the path by."""
        if self.stated_m is not None:
            return self.sigma_m[self.agree]
        off_m, many = self.misfit_m[self.agree], int(self.agree.sum())
        sigma_m = math.sqrt((_UNSTATED_M**2 + np.sum(off_m**2)) / max(1, 3 * many - 4))
        return np.full(many, min(RECEIVER_M, sigma_m))

    @property
    def uneven_m(self) -> float:
        """Standard deviation of a coordinate, by how evenly the positions differ from the path."""
        curvature_m = np.abs(np.diff(self.misfit_m[self.agree], n=2, axis=0))
        median_m = float(np.median(curvature_m)) if len(curvature_m) else 0.0
        return float(_SIGMA_OF_CURVATURE * median_m)

    def check(self, drift_m: float, where: Path) -> None:
        """Refuse positions that neither the drift of the path nor their noise explains."""
        swapped = "; ".join(self._swapped())
        if swapped and self.degrees:
            what, hint = "latitude and longitude are swapped", "the file has latitude first"
            raise EvaluationError(what, where=where, got=swapped, hint=hint)
        hint = swapped or "have they its clock, metres, and the offset of the antenna?"
        sigma_m = RECEIVER_M
        if self.stated_m is not None:
            sigma_m = float(np.sqrt(np.mean(self.stated_m[self.agree] ** 2)))
        ours_m, position_m = self.ours_m[self.agree], self.position_m[self.agree]
        fit_to_path(ours_m, position_m, drift_m, sigma_m).check(where, hint)
        if self.uneven_m > SIGMAS * sigma_m:
            raise EvaluationError(
                "positions jump from one to the next",
                where=where,
                got=f"a standard deviation of {self.uneven_m:.3g} m",
                expected=f"{sigma_m:g} m, as "
                + ("of a receiver" if self.stated_m is None else "the file states"),
            )

    def warnings(self) -> list[str]:
        """Return lines of positions that are left out, and of columns that seem swapped."""
        late = []
        if self.time_offset_s:
            by = f"{abs(self.time_offset_s):.2f} s {'late' if self.time_offset_s > 0 else 'early'}"
            kept = f"(± {self.time_offset_sigma_s:.2g} s), and taken as that"
            late = [f"the clock of the positions is {by} beside that of the images {kept}"]
        return [*late, *self._left_out(), *self._swapped()]

    def _swapped(self) -> list[str]:
        """Return a line if the path, which may curve left or right, is that of a mirror image."""
        ours_m, position_m = self.ours_m[self.agree], self.position_m[self.agree]
        if len(ours_m) < _FEWEST_TO_BEND:
            return []
        mirrored_m = self.position_m[:, [1, 0, 2]] if self.swapped_m is None else self.swapped_m
        as_given, swapped = (
            float(np.sqrt(3.0 * np.mean(_off_m(ours_m, there_m) ** 2)))
            for there_m in (position_m, mirrored_m[self.agree])
        )
        if swapped > 0.5 * as_given or as_given < _LEAST_BEND_M:
            return []
        better = f"{metres(swapped)} instead of {metres(as_given)} (RMS)"
        if self.degrees:
            return [better]
        ask = "columns are time, easting, northing, height"
        return [f"with easting and northing swapped the positions fit better, {better}: {ask}"]

    def _left_out(self) -> list[str]:
        off_m = np.linalg.norm(self.misfit_m, axis=1)
        worst = [n for n in np.argsort(-off_m) if not self.agree[n]]
        if not worst:
            return []
        named = [f"at {self.times_s[n]:.3f} s ({metres(off_m[n])} off)" for n in worst[:_NAMED]]
        more = ", …" if len(worst) > _NAMED else ""
        of_all = f"{len(worst)} of {counted(len(off_m), 'position')}"
        return [f"{of_all} contradict the others and are left out: {', '.join(named)}{more}"]


def _off_m(ours_m: Float64, there_m: Float64) -> Float64:
    """Return by how much positions are off after a rigid fit (N, 3)."""
    return np.asarray(apply(fit_upright(ours_m, there_m).T_to_from, ours_m) - there_m)


def measure_along(session: Session, survey: Survey) -> Measured:
    """Return the positions that were measured during a drive, and where its path has them."""
    rows, path = survey.rows, _trusted_path(session)
    T_map_world = session.T_map_world
    antenna_m = _in_camera(survey, T_map_world)

    def ours_at(times_s: Float64) -> Float64:
        return _placed(T_map_world @ interpolate_poses(path, times_s), antenna_m)

    time_offset_s, time_offset_sigma_s = clock_error(path, rows, ours_at, session.scale)
    rows = rows - np.array([time_offset_s, *[0.0] * 6])
    during = _during(path, rows[:, 0])
    here = rows[during]
    if not len(here):
        raise EvaluationError(
            "no position was measured during the drive",
            where=survey.positions,
            got=f"times {rows[0, 0]:.3f} to {rows[-1, 0]:.3f} s",
            expected=f"times within {path.timestamps_s[0]:.3f} to {path.timestamps_s[-1]:.3f} s",
            hint="both need one clock",
        )
    position_m, sigma_m = here[:, 1:4], np.sqrt(np.mean(here[:, 4:] ** 2, axis=1))
    ours_m = ours_at(here[:, 0])
    agree = find_agreeing(ours_m, position_m, LARGEST_MISFIT * span_m(ours_m))
    stated_m = None if np.isnan(sigma_m).any() else sigma_m
    measured = Measured(
        *(here[:, 0], position_m, ours_m, agree, stated_m, survey.swapped_m[during]),
        *(time_offset_s, time_offset_sigma_s, survey.found.degrees),
    )
    places_m = apply(measured.T_survey_map, ours_m[agree]), position_m[agree]
    turn = fixed_turn(*places_m, measured.turn_sigma_m, survey.positions, "positions")
    measured = replace(measured, turn=turn)
    path = session.odometry
    stated = expected_drift(path, session.health, session.camera)
    drift_m = drift_at_end(path, session.trusted, None if stated is None else stated.percent)
    measured.check(drift_m, survey.positions)
    return measured


def fixed_turn(
    ours_m: Float64, there_m: Float64, sigma_m: Float64, where: Path, what: str
) -> Float64:
    """Return the covariance (3, 3), rad², of the rotation that points (N, 3) fix, survey axes.

    By their standard deviations (N,) and their spread as the map or the survey has them, wherever
    that says less of the yaw.

    Raises:
        EvaluationError: The yaw is not fixed.
    """
    found = [turn_covariance(points_m, sigma_m, LEVEL_RAD) for points_m in (ours_m, there_m)]
    worse = max(found, key=lambda covariance: float(covariance[2, 2]))
    yaw_rad = math.sqrt(worse[2, 2])
    if yaw_rad > _MOST_YAW_RAD:
        apart = f"{counted(len(there_m), 'place')} within {metres(span_m(there_m[:, :2]))}"
        yaw_deg = min(180.0, math.degrees(yaw_rad))
        raise EvaluationError(
            f"the {what} do not say how the map is turned",
            where=where,
            got=f"{apart}, known to {np.median(sigma_m):.2g} m: a direction to {yaw_deg:.0f} deg",
            expected=f"{math.degrees(_MOST_YAW_RAD):.0f} deg or better",
            hint="measure places farther apart; eastings and northings are in metres, not degrees",
        )
    return worse


def hold(map_: MapFile, survey: Survey) -> list[str]:
    """Keep what was measured during any drive with it, for `join_sessions`; returns warnings."""
    times_s, lines = survey.rows[:, 0], list[str]()
    sessions = [each for each in map_.sessions if _during(_trusted_path(each), times_s).any()]
    for session in sessions or map_.sessions[:1]:  # of none, the first says why
        measured, path = measure_along(session, survey), _trusted_path(session)
        # Those that agree, by frame; between frames the path is trusted.
        times_s, T_world_frame = measured.times_s[measured.agree], session.trajectory.T_world_camera
        frames = nearest_sorted(times_s, session.trajectory.timestamps_s)
        T_frame_camera = invert(T_world_frame[frames]) @ interpolate_poses(path, times_s)
        session.set_fixes(
            Fixes(
                frames,
                _placed(T_frame_camera, _in_camera(survey, session.T_map_world)),
                measured.position_m[measured.agree],
                measured.sigma_m[measured.agree],
            )
        )
        lines += measured.warnings()
    return [*survey.notes(), *lines]


def misfit_rms_m(map_: MapFile) -> float | None:
    """Return by how much linked paths and positions differ (RMS), fitted rigidly; None = none."""
    held = [session for session in map_.linked if len(session.fixes)]
    if not held:
        return None
    ours_m = np.concatenate(
        [apply(one.T_map_world, one.fixes.by_path(one.trajectory)) for one in held]
    )
    position_m = np.concatenate([one.fixes.position_m for one in held])
    return float(np.sqrt(np.mean(np.sum(_off_m(ours_m, position_m) ** 2, axis=1))))


def doubts_of_positions(map_: MapFile) -> list[str]:
    """Return a warning if paths constrained by measured positions are still far from them."""
    off_m = misfit_rms_m(map_)
    extent_m = max((span_m(each.trajectory.positions_m) for each in map_.linked), default=0.0)
    if off_m is None or off_m <= LARGEST_MISFIT * extent_m:
        return []
    why = "another clock, another antenna offset, other units, or positions that are no better"
    return [f"the paths are {metres(off_m)} from the measured positions (RMS): {why}"]


def _placed(T: Float64, point_m: Float64) -> Float64:
    """Return a point (3,) by transforms (N, 4, 4): float64 (N, 3)."""
    return np.asarray(T[:, :3, :3] @ point_m + T[:, :3, 3])


def _in_camera(survey: Survey, T_map_world: Float64) -> Float64:
    """Return where the antenna is (3,), in axes of the camera that begins a drive."""
    R_map_camera = T_map_world[:3, :3]
    forward, up = R_map_camera[:, 2] * [1.0, 1.0, 0.0], np.array([0.0, 0.0, 1.0])
    forward = forward / np.linalg.norm(forward)
    R_map_vehicle = np.column_stack([forward, np.cross(up, forward), up])
    return np.asarray(R_map_camera.T @ R_map_vehicle @ np.asarray(survey.antenna_m))


def _trusted_path(session: Session) -> Trajectory:
    return session.trajectory.select(session.trusted)


def span_m(positions: Float64) -> float:
    """Return the diagonal of the box around positions (N, 3)."""
    return float(np.linalg.norm(np.ptp(positions, axis=0)))


def _during(path: Trajectory, times_s: Float64) -> Bool:
    frames_s = path.timestamps_s
    inside = (times_s >= frames_s[0]) & (times_s <= frames_s[-1])
    near_s = np.abs(frames_s[nearest_sorted(times_s, frames_s)] - times_s)
    return np.asarray(inside & (near_s <= 0.5 * _LONGEST_GAP_S))
