"""Trajectory errors: KITTI's relative errors over segments, ATE and RPE."""

from __future__ import annotations

from dataclasses import dataclass
from os import PathLike
from pathlib import Path
from typing import Annotated, Any, Final, Literal

import numpy as np
from pydantic import Field

from recon.core.errors import EvaluationError
from recon.core.geometry.alignment import Similarity, fit_points, fit_upright
from recon.core.geometry.se3 import angle_rad, exp_so3, invert, quaternion_from_rotation
from recon.core.settings import Settings
from recon.core.text import counted
from recon.core.values import LengthErrors, SequenceTruth, Trajectory, TrajectoryMetrics
from recon.core.values.arrays import Float64, Int32
from recon.evaluation.segments import Segments, choose_segments
from recon.io.files import StrPath
from recon.io.trajectory import read_trajectory
from recon.places.places import drift_at_end, fit_to_path

# On a shorter path, relative errors would be dominated by the noise of the ground truth.
MIN_PATH_M: Final = 1.0


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

    estimate: Trajectory  # the aligned estimate
    truth: Trajectory  # the true trajectory, pose by pose
    segments: Segments  # the segments of the relative errors
    segment_percent: Float64  # (N,), translation error of each segment, per cent of its length
    segment_deg_per_100m: Float64  # (N,), rotation error of each segment
    metrics: TrajectoryMetrics  # the summary
    motion: Similarity  # what aligned the estimate

    @property
    def position_errors_m(self) -> Float64:
        """float64 (N,): distance of each position from the true one."""
        away = self.estimate.positions_m - self.truth.positions_m
        return np.asarray(np.linalg.norm(away, axis=1))

    @property
    def roll_axis(self) -> Float64 | None:
        """float64 (3,): direction of a straight path whose alignment leaves the roll about it open.

        None if the positions fix every rotation, or if they are not what was aligned.
        """
        if self.metrics.alignment not in ("se3", "sim3"):
            return None
        return open_roll_axis(self.estimate, self.truth)

    @property
    def rotation_errors_rad(self) -> Float64:
        """float64 (N,): angle between each orientation and the true one.

        Where the alignment leaves the roll open (`roll_axis`), the estimate is rolled to fit best:
        the common roll would be an error of the alignment, not of the estimate.
        """
        axis, estimate = self.roll_axis, self.estimate
        if axis is not None:
            estimate = without_roll(estimate, self.truth, axis)
        return angle_rad(invert(self.truth.T_world_camera) @ estimate.T_world_camera)


@dataclass(frozen=True, eq=False)
class TrajectoryRun:
    """The result of a comparison."""

    estimate: Path  # file of the estimate
    truth: Path  # file of the ground truth
    comparison: TrajectoryComparison  # the two paths, aligned, and their differences
    summary: dict[str, Any]  # the figures of ``summary.json``


def evaluate_trajectory(
    estimate: Trajectory | StrPath,
    truth: Trajectory | SequenceTruth | StrPath,
    rules: TrajectoryRules | None = None,
) -> TrajectoryMetrics:
    """Return the errors of an estimated trajectory, see `compare_paths`.

    Args:
        estimate: The estimate, or its KITTI or TUM file.
        truth: The true path, its file, or what a source knows of the truth.
        rules: Alignment and segments; None = the defaults.

    Raises:
        EvaluationError: The two cannot be compared, or one is no trajectory.
        FormatError: A file is missing or damaged.
    """
    return compare_paths(_path("estimate", estimate), _path("truth", truth), rules).metrics


def _path(name: str, given: object) -> Trajectory:
    """Return a trajectory, that of a file, or that of the truth of a source."""
    found = given.trajectory if isinstance(given, SequenceTruth) else given
    if isinstance(found, str | PathLike):
        return read_trajectory(found)
    if isinstance(found, Trajectory):
        return found
    raise EvaluationError(
        f"the {name} is no trajectory",
        got=f"{type(given).__name__} without a path" if found is None else type(given).__name__,
        expected="a Trajectory, a KITTI or TUM file, or the truth of a source",
    )


def compare_paths(
    estimate: Trajectory, truth: Trajectory, rules: TrajectoryRules | None = None
) -> TrajectoryComparison:
    """Compare an estimated trajectory with the true one, pose by pose.

    Relative errors follow the KITTI development kit: segments of 100 to 800 m, as far as the true
    path has room for them, starting at every tenth frame; the error of a segment is the error of
    the motion over it, divided by its length; the mean is over all segments. A drive with room for
    fewer than two of these lengths uses segments of 50 and 100 m instead, starting at every frame,
    and a drive of 50 m or less uses segments of half its length. The scale of the alignment affects
    all errors, its rigid part only the ATE.

    Ref: Geiger, Lenz, Urtasun, "Are we ready for autonomous driving?", CVPR 2012; Sturm et al., "A
    benchmark for the evaluation of RGB-D SLAM systems", IROS 2012.
    """
    rules = rules or TrajectoryRules()
    _check(estimate, truth, rules)
    motion = align(estimate, truth, rules.alignment)
    estimate = motion.move(estimate)
    segments = choose_segments(truth.distances_m, rules.lengths_m, rules.step_frames)
    translation_m, rotation_rad = motion_errors(estimate, truth, segments.first, segments.last)
    percent = 100.0 * translation_m / segments.length_m
    deg_per_100m = 100.0 * np.rad2deg(rotation_rad) / segments.length_m
    frames = np.arange(len(truth), dtype=np.int32)
    apart = rules.rpe_frames
    step_m, step_rad = motion_errors(estimate, truth, frames[:-apart], frames[apart:])
    away_m = np.linalg.norm(estimate.positions_m - truth.positions_m, axis=1)
    metrics = TrajectoryMetrics(
        t_rel_percent=float(np.mean(percent)),
        r_rel_deg_per_100m=float(np.mean(deg_per_100m)),
        ate_m=_rms(away_m),
        rpe_m=_rms(step_m),
        rpe_deg=float(np.rad2deg(_rms(step_rad))),
        path_length_m=truth.path_length_m,
        frames=len(truth),
        segment_lengths_m=tuple(float(length) for length in np.unique(segments.length_m)),
        segments=len(segments.first),
        alignment=rules.alignment,
        scale=motion.scale,
        ate_median_m=float(np.median(away_m)),
        ate_max_m=float(np.max(away_m)),
        by_length=_by_length(segments, percent, deg_per_100m),
    )
    return TrajectoryComparison(estimate, truth, segments, percent, deg_per_100m, metrics, motion)


def align(estimate: Trajectory, truth: Trajectory, alignment: str) -> Similarity:
    """Return the transform of the estimate for `TrajectoryRules.alignment`."""
    if alignment == "none":
        return Similarity(np.eye(4))
    if alignment == "origin":
        return Similarity(truth.T_world_camera[0] @ invert(estimate.T_world_camera[0]))
    if alignment == "upright":
        return fit_upright(estimate.positions_m, truth.positions_m)
    scaled = alignment == "sim3"
    return fit_points(estimate.positions_m, truth.positions_m, scaled=scaled)


def motion_errors(
    estimate: Trajectory, truth: Trajectory, first: Int32, last: Int32
) -> tuple[Float64, Float64]:
    """Return errors of the motion between two frames: metres (N,) and radians (N,)."""
    poses, true = estimate.T_world_camera, truth.T_world_camera
    motion: Float64 = invert(poses[first]) @ poses[last]
    wrong = invert(motion) @ (invert(true[first]) @ true[last])
    return np.linalg.norm(wrong[:, :3, 3], axis=1), angle_rad(wrong)


def _by_length(
    segments: Segments, percent: Float64, deg_per_100m: Float64
) -> tuple[LengthErrors, ...]:
    return tuple(
        LengthErrors(
            length_m=float(length_m),
            t_rel_percent=float(np.mean(percent[segments.length_m == length_m])),
            r_rel_deg_per_100m=float(np.mean(deg_per_100m[segments.length_m == length_m])),
            segments=int((segments.length_m == length_m).sum()),
        )
        for length_m in np.unique(segments.length_m)
    )


def _rms(values: Float64) -> float:
    return float(np.sqrt(np.mean(np.square(values))))


def _check(estimate: Trajectory, truth: Trajectory, rules: TrajectoryRules) -> None:
    if len(estimate) != len(truth):
        raise EvaluationError(
            "estimated and true trajectory differ in length",
            got=counted(len(estimate), "pose"),
            expected=counted(len(truth), "pose"),
            hint="without timestamps (TUM, or --times) both must have one pose per frame",
        )
    least = rules.rpe_frames + 1
    if len(truth) < least:
        raise EvaluationError(
            "too few poses to compare", got=counted(len(truth), "pose"), expected=f"{least} or more"
        )
    if truth.path_length_m < MIN_PATH_M:
        raise EvaluationError(
            "true path is too short for errors relative to its length",
            got=f"{truth.path_length_m:.2f} m",
            expected=f"{MIN_PATH_M:g} m or more",
        )
    drift_m = min(drift_at_end(estimate), drift_at_end(truth))
    fit = fit_to_path(estimate.positions_m, truth.positions_m, drift_m)
    if fit.other_unit and rules.alignment != "sim3":
        raise EvaluationError(
            "the true path is the estimated one in another unit",
            got=f"{fit.scale:.4g} times as large, {fit.scaled_m:.3g} m apart if that is undone",
            hint="both are in metres; sim3 compares an estimate whose scale is unknown",
        )


# A path is straight if its width (rms) is at most this share of its length (rms).
_STRAIGHT: Final = 0.05
# The positions fix the roll to about their error over the width of the path, in radians.
_FIXED_RAD: Final = float(np.radians(0.5))


def open_roll_axis(estimate: Trajectory, truth: Trajectory) -> Float64 | None:
    """Return the direction of a straight path about which aligned positions do not fix the roll.

    float64 (3,), world axes of ``truth``; None if the positions fix every rotation. The estimate is
    aligned to the true path by positions.
    """
    centred = truth.positions_m - truth.positions_m.mean(axis=0)
    _, _, directions = np.linalg.svd(centred, full_matrices=False)
    along = directions[0]
    length_m, width_m = _extent(centred @ along), _extent(_across(centred, along))
    away_m = _extent(_across(estimate.positions_m - truth.positions_m, along))
    fixed = away_m < _FIXED_RAD * width_m
    return None if fixed or width_m > _STRAIGHT * length_m else np.asarray(along)


def without_roll(estimate: Trajectory, truth: Trajectory, axis: Float64) -> Trajectory:
    """Return the estimate with its poses rolled alike about an axis until their rotations fit best.

    Positions stay as they are: across the axis they are too close to it to be moved.
    """
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
