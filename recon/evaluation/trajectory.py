"""Trajectory errors: KITTI's relative errors over segments, ATE and RPE."""

from __future__ import annotations

import math
from dataclasses import dataclass
from os import PathLike
from typing import Annotated, Final, Literal, NamedTuple

import numpy as np
from pydantic import Field

from recon.core.errors import EvaluationError
from recon.core.geometry.alignment import Similarity, fit_points, fit_upright, nearest_sorted
from recon.core.geometry.se3 import angle_rad, exp_so3, invert, quaternion_from_rotation
from recon.core.settings import Settings
from recon.core.text import counted, metres
from recon.core.values import LengthErrors, SequenceTruth, Trajectory, TrajectoryMetrics
from recon.core.values.arrays import Bool, Float64, Int32
from recon.io.files import StrPath
from recon.io.trajectory import ORDER_HINT, holds_times, read_trajectory, reordered
from recon.places.places import drift_at_end, fit_to_path

# A camera that moved less stood still, be it an endoscope: errors relative to it say nothing.
MIN_PATH_M: Final = 0.01
_STRAIGHT: Final = 0.05  # largest width of a straight path, as fraction of its length (both rms)
# The positions fix the roll to about their error over the width of the path, in radians.
_NONSENSE: Final = 0.5  # of the length of a motion, by which it is off: of one turned by 29 degrees
_FIXED_RAD: Final = float(np.radians(0.5))
TOLERANCE_S: Final = 0.01  # largest time difference of two associated poses


class TrajectoryRules(Settings):
    """Alignment and segments of a trajectory comparison."""

    alignment: Literal["none", "origin", "se3", "sim3", "upright"] = "se3"
    """Alignment of the estimate: none, at the first pose (origin), rigid (se3), or rigid with scale
    (sim3), or rigid where z is up in both (upright)."""
    lengths_m: tuple[Annotated[float, Field(ge=1e-6, le=1e9)], ...] | None = Field(
        None, min_length=1
    )
    """Lengths of the segments in metres; null = chosen by the length of the path."""
    step_frames: int | None = Field(None, ge=1, le=1_000_000_000)
    """Frames between the starts of segments; null = chosen by the length of the path."""
    rpe_frames: int = Field(1, ge=1, le=1_000_000_000)
    """Frame distance of the RPE."""


@dataclass(frozen=True, eq=False)
class TrajectoryComparison:
    """Two trajectories and their differences, as needed for plots."""

    estimate: Trajectory  # aligned
    truth: Trajectory
    segments: Segments  # of the relative errors
    position_errors_m: Float64  # (F,), distance of each position from the true one
    segment_percent: Float64  # (N,), translation error of each segment, per cent of its length
    segment_deg_per_100m: Float64  # (N,), rotation error of each segment
    metrics: TrajectoryMetrics
    motion: Similarity  # what aligned the estimate

    @property
    def roll_axis(self) -> Float64 | None:
        """Direction of a straight path, about which the alignment of positions leaves it open.

        float64 (3,), world axes of ``truth``; None if the alignment fixes every rotation.
        """
        if self.metrics.alignment not in ("se3", "sim3"):
            return None
        true_m = self.truth.positions_m
        centred = true_m - true_m.mean(axis=0)
        along = np.linalg.svd(centred, full_matrices=False)[2][0]
        length_m, width_m = _extent(centred @ along), _extent(_across(centred, along))
        away_m = _extent(_across(self.estimate.positions_m - true_m, along))
        fixed = away_m < _FIXED_RAD * width_m
        return None if fixed or width_m > _STRAIGHT * length_m else np.asarray(along)

    @property
    def rotation_errors_rad(self) -> Float64:
        """float64 (N,): angle between each orientation and the true one.

        Where the alignment leaves the roll open (`roll_axis`), the estimate is rolled to fit best.
        """
        estimate = self.estimate
        if (axis := self.roll_axis) is not None:
            estimate = without_roll(estimate, self.truth, axis)
        return angle_rad(invert(self.truth.T_world_camera) @ estimate.T_world_camera)


def evaluate_trajectory(
    estimate: Trajectory | StrPath,
    truth: Trajectory | SequenceTruth | StrPath,
    rules: TrajectoryRules | None = None,
    *,
    tolerance_s: float = TOLERANCE_S,
) -> TrajectoryMetrics:
    """Return the errors of an estimated trajectory, see `compare_paths`.

    Poses of two files with times (TUM) are associated by time, as `recon evaluate trajectory` does;
    all others, and `Trajectory` values, whose times may be mere numbers, are compared in order.

    Args:
        estimate: The estimate, or its KITTI or TUM file.
        truth: The true path, its file, or what a source knows of the truth.
        rules: Alignment and segments; None = the defaults.
        tolerance_s: Largest time difference of two associated poses, seconds.

    Raises:
        EvaluationError: The two cannot be compared, or one is no trajectory.
        FormatError: A file is missing or damaged.
    """
    ours, true = _path("estimate", estimate), _path("truth", truth)
    if all(isinstance(one, str | PathLike) and holds_times(one) for one in (estimate, truth)):
        ours, true = associate(ours, true, tolerance_s)
    return compare_paths(ours, true, rules).metrics


def _path(name: str, given: object) -> Trajectory:
    found = given.trajectory if isinstance(given, SequenceTruth) else given
    if isinstance(found, str | PathLike):
        return read_trajectory(found)
    if isinstance(found, Trajectory):
        return found
    got = type(given).__name__ + (" without a path" if found is None else "")
    expected = "a Trajectory, a KITTI or TUM file, or the truth of a source"
    raise EvaluationError(f"the {name} is no trajectory", got=got, expected=expected)


def compare_paths(
    estimate: Trajectory, truth: Trajectory, rules: TrajectoryRules | None = None
) -> TrajectoryComparison:
    """Compare an estimated trajectory with the true one, pose by pose.

    Relative errors follow the KITTI development kit: means over `choose_segments` of the error of
    the motion, divided by the length. The scale of the alignment affects all errors, its rigid part
    only the ATE.

    Ref: Geiger, Lenz, Urtasun, "Are we ready for autonomous driving?", CVPR 2012; Sturm et al., "A
    benchmark for the evaluation of RGB-D SLAM systems", IROS 2012.
    """
    rules = rules or TrajectoryRules()
    _check(estimate, truth, rules)
    motion = align(estimate, truth, rules.alignment)
    segments = choose_segments(truth.distances_m, rules.lengths_m, rules.step_frames)
    _check_orders(estimate, truth, motion, segments)
    estimate = motion.move(estimate)
    translation_m, rotation_rad = motion_errors(estimate, truth, segments.first, segments.last)
    percent = 100.0 * translation_m / segments.length_m
    degrees = 100.0 * np.rad2deg(rotation_rad) / segments.length_m
    lengths_m = np.unique(segments.length_m).tolist()
    frames, apart = np.arange(len(truth), dtype=np.int32), rules.rpe_frames
    step_m, step_rad = motion_errors(estimate, truth, frames[:-apart], frames[apart:])
    away_m = np.linalg.norm(estimate.positions_m - truth.positions_m, axis=1)
    metrics = TrajectoryMetrics(
        t_rel_percent=float(np.mean(percent)),
        r_rel_deg_per_100m=float(np.mean(degrees)),
        ate_m=_rms(away_m),
        rpe_m=_rms(step_m),
        rpe_deg=float(np.rad2deg(_rms(step_rad))),
        path_length_m=truth.path_length_m,
        frames=len(truth),
        segment_lengths_m=tuple(lengths_m),
        segments=len(segments.first),
        alignment=rules.alignment,
        scale=motion.scale,
        ate_median_m=float(np.median(away_m)),
        ate_max_m=float(np.max(away_m)),
        by_length=tuple(
            LengthErrors(m, float(percent[of].mean()), float(degrees[of].mean()), int(of.sum()))
            for m, of in ((m, segments.length_m == m) for m in lengths_m)
        ),
    )
    return TrajectoryComparison(
        estimate, truth, segments, away_m, percent, degrees, metrics, motion
    )


def align(estimate: Trajectory, truth: Trajectory, alignment: str) -> Similarity:
    """Return the transform of the estimate for `TrajectoryRules.alignment`."""
    if alignment == "none":
        return Similarity(np.eye(4))
    if alignment == "origin":
        return Similarity(truth.T_world_camera[0] @ invert(estimate.T_world_camera[0]))
    if alignment == "upright":
        return fit_upright(estimate.positions_m, truth.positions_m)
    return fit_points(estimate.positions_m, truth.positions_m, scaled=alignment == "sim3")


def motion_errors(
    estimate: Trajectory, truth: Trajectory, first: Int32, last: Int32
) -> tuple[Float64, Float64]:
    """Return errors of the motion between two frames: metres (N,) and radians (N,)."""
    poses, true = estimate.T_world_camera, truth.T_world_camera
    motion: Float64 = invert(poses[first]) @ poses[last]
    wrong = invert(motion) @ (invert(true[first]) @ true[last])
    return np.linalg.norm(wrong[:, :3, 3], axis=1), angle_rad(wrong)


def _check_orders(
    estimate: Trajectory, truth: Trajectory, motion: Similarity, segments: Segments
) -> None:
    """Refuse orientations that agree only with the quaternions of one path in the other order."""

    def off(ours: Trajectory, true: Trajectory) -> float:
        wrong_m, _ = motion_errors(motion.move(ours), true, segments.first, segments.last)
        return float(np.mean(wrong_m / segments.length_m))

    ratio = off(estimate, truth)
    if ratio < _NONSENSE:
        return
    others = {"estimate": off(reordered(estimate), truth), "truth": off(estimate, reordered(truth))}
    name, least = min(others.items(), key=lambda item: item[1])
    if least < 0.1 * ratio:
        what = f"the quaternions of the {name} are not in the order of TUM, qx qy qz qw"
        got = f"t_rel {ratio:.0%}, and {least:.2%} as qw qx qy qz"
        raise EvaluationError(what, got=got, hint=ORDER_HINT)


def _rms(values: Float64) -> float:
    return float(np.sqrt(np.mean(np.square(values))))


def _check(estimate: Trajectory, truth: Trajectory, rules: TrajectoryRules) -> None:
    if len(estimate) != len(truth):
        got, expected = counted(len(estimate), "pose"), counted(len(truth), "pose")
        what = "estimated and true trajectory differ in length"
        hint = "without timestamps (TUM, or --times) both must have one pose per frame"
        raise EvaluationError(what, got=got, expected=expected, hint=hint)
    least = rules.rpe_frames + 1
    if len(truth) < least:
        got, expected = counted(len(truth), "pose"), f"{least} or more"
        raise EvaluationError("too few poses to compare", got=got, expected=expected)
    if truth.path_length_m < MIN_PATH_M:
        what = "true path is too short for errors relative to its length"
        got, expected = metres(truth.path_length_m), f"{MIN_PATH_M:g} m or more"
        raise EvaluationError(what, got=got, expected=expected)
    drift_m = min(drift_at_end(estimate), drift_at_end(truth))
    fit = fit_to_path(estimate.positions_m, truth.positions_m, drift_m)
    if fit.other_unit and rules.alignment != "sim3":
        what = "the true path is the estimated one in another unit"
        got = f"{fit.scale:.4g} times as large, {fit.scaled_m:.3g} m apart if that is undone"
        hint = "both are in metres; sim3 compares an estimate whose scale is unknown"
        raise EvaluationError(what, got=got, hint=hint)


def without_roll(estimate: Trajectory, truth: Trajectory, axis: Float64) -> Trajectory:
    """Roll all poses alike about an axis until their rotations fit best; positions stay."""
    wrong = truth.T_world_camera[:, :3, :3] @ np.swapaxes(estimate.T_world_camera[:, :3, :3], 1, 2)
    xyzw = np.array([quaternion_from_rotation(each) for each in wrong])
    rolls = 2 * np.arctan2(xyzw[:, :3] @ axis, xyzw[:, 3])
    mean = np.arctan2(np.sin(rolls).mean(), np.cos(rolls).mean())
    poses = estimate.T_world_camera.copy()
    poses[:, :3, :3] = exp_so3(mean * axis) @ poses[:, :3, :3]
    return Trajectory(poses, estimate.timestamps_s)


def _across(vectors: Float64, axis: Float64) -> Float64:
    return np.asarray(vectors - np.outer(vectors @ axis, axis))


def _extent(values: Float64) -> float:
    return float(np.sqrt((values**2).sum() / len(values)))


KITTI_LENGTHS_M: Final = (100.0, 200.0, 300.0, 400.0, 500.0, 600.0, 700.0, 800.0)
SHORT_LENGTHS_M: Final = (50.0, 100.0)  # for a drive with no room for two of KITTI's
KITTI_STEP_FRAMES: Final = 10  # the benchmark starts a segment at every tenth frame (one second)


class Segments(NamedTuple):
    """Segments of the true path."""

    first: Int32  # (N,), frames
    last: Int32  # (N,), frames
    length_m: Float64  # (N,), nominal


def choose_segments(
    distances_m: Float64, lengths_m: tuple[float, ...] | None = None, step_frames: int | None = None
) -> Segments:
    """Choose segments by the true path length (N,) from the first pose to each.

    Without lengths: the benchmark's that fit, for a shorter drive 50 and 100 m, or half its length;
    without a step between starts: 10 frames, or 1 for the shorter lengths.
    """
    lengths = lengths_m or KITTI_LENGTHS_M
    segments = segments_of(distances_m, lengths, step_frames or KITTI_STEP_FRAMES)
    if lengths_m is not None and not len(segments.first):
        what = "true path has no room for a segment of the requested lengths"
        got, expected = f"a path of {metres(distances_m[-1])}", f"more than {min(lengths_m):g} m"
        raise EvaluationError(what, got=got, expected=expected)
    if lengths_m is not None or len(np.unique(segments.length_m)) >= 2:
        return segments
    segments = segments_of(distances_m, SHORT_LENGTHS_M, step_frames or 1)
    if len(segments.first):
        return segments
    return segments_of(distances_m, (0.5 * float(distances_m[-1]),), 1)


def segments_of(distances_m: Float64, lengths_m: tuple[float, ...], step: int) -> Segments:
    """Return segments from every ``step``-th frame to the first that is farther along the path."""
    starts = np.arange(0, len(distances_m), step)
    first = np.repeat(starts, len(lengths_m))
    length_m = np.tile(np.asarray(lengths_m, dtype=np.float64), len(starts))
    last = np.searchsorted(distances_m, distances_m[first] + length_m, side="right")
    fits = last < len(distances_m)
    return Segments(first[fits].astype(np.int32), last[fits].astype(np.int32), length_m[fits])


_UNITS: Final = {1: "milliseconds", 2: "microseconds", 3: "nanoseconds"}
_SAME_UNIT: Final = 0.1  # a third of a decade: of one drive, paths that last twice as long do not


def associate(
    estimate: Trajectory, truth: Trajectory, tolerance_s: float
) -> tuple[Trajectory, Trajectory]:
    """Match poses that are mutually nearest in time, on one clock; others are left out."""
    there = nearest_sorted(estimate.timestamps_s, truth.timestamps_s)
    back = nearest_sorted(truth.timestamps_s, estimate.timestamps_s)
    apart_s = np.abs(truth.timestamps_s[there] - estimate.timestamps_s)
    mutual = (back[there] == np.arange(len(estimate))) & (apart_s <= tolerance_s)
    if not mutual.any():
        times = (estimate.timestamps_s, truth.timestamps_s)
        got = "times " + " and ".join(f"{t[0]:.3f} to {t[-1]:.3f} s" for t in times)
        expected = f"times within {tolerance_s:g} s of each other"
        what = "no poses of the two trajectories match in time"
        hint = "raise --tolerance, or make sure that both use the same clock"
        hint = _units_apart(estimate, truth) or hint
        raise EvaluationError(what, got=got, expected=expected, hint=hint)
    return estimate.select(mutual), truth.select(there[mutual])


def _units_apart(estimate: Trajectory, truth: Trajectory) -> str:
    """Return a line if one path lasts a thousand, million or billion times as long; else none."""
    ours_s, true_s = (float(np.ptp(path.timestamps_s)) for path in (estimate, truth))
    powers = math.log10(ours_s / true_s) / 3 if min(ours_s, true_s) > 0 else 0.0
    unit = _UNITS.get(abs(round(powers)))
    if unit is None or abs(powers - round(powers)) > _SAME_UNIT:
        return ""
    names = ("estimate", "truth")[:: 1 if powers > 0 else -1]
    return f"timestamps of the {names[0]} are {unit}, where those of the {names[1]} are seconds"


# A turn changes evenly from frame to frame if it does so less than this fraction of the median.
_EVEN: Final = 0.02
_LEAST_CHANGES: Final = 5  # fewer even changes in a row may be chance
# Where turns change less than this everywhere, the digits of the file decide: KITTI has six.
_LEAST_MEDIAN_RAD: Final = 5e-5


def interpolated_poses(path: Trajectory) -> Bool:
    """Return bool (N,): poses along which the path turns at one rate, as it does nowhere else.

    A path that turns evenly for the most part has none, as rendered ones do.
    """
    found = np.zeros(len(path), np.bool_)
    if len(path) < _LEAST_CHANGES + 2:
        return found
    step = invert(path.T_world_camera[:-1]) @ path.T_world_camera[1:]
    change = angle_rad(invert(step[:-1]) @ step[1:])
    typical = float(np.median(change))
    even = (change < _EVEN * typical) & (typical > _LEAST_MEDIAN_RAD)
    runs = np.lib.stride_tricks.sliding_window_view(even, _LEAST_CHANGES).all(axis=1)
    for first in np.flatnonzero(runs):
        found[first : first + _LEAST_CHANGES + 2] = True
    return found


def interpolation_warnings(truth: Trajectory, segments: Segments) -> list[str]:
    """Return what to know of relative errors: how many rest on poses that nobody measured."""
    found = interpolated_poses(truth)
    if not found.any():
        return []
    resting = int((found[segments.first] | found[segments.last]).sum())
    first, last = np.flatnonzero(found)[[0, -1]]
    which = f"{counted(int(found.sum()), 'true pose')} (between {first} and {last})"
    where = f"{resting} of {counted(len(segments.first), 'segment')} begin or end there"
    doubt = "as interpolated ones do, so part of the drift may be the truth's"
    return [f"{which} turn evenly, {doubt}: {where}"]
