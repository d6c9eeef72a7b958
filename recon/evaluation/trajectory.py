"""How far an estimated trajectory is from the true one, to the KITTI benchmark's rules."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Final

import numpy as np

from recon.errors import EvaluationError
from recon.geometry.se3 import angle_rad, invert
from recon.structures import Trajectory, TrajectoryMetrics
from recon.structures.arrays import Float64, Int32

KITTI_LENGTHS_M: Final = (100.0, 200.0, 300.0, 400.0, 500.0, 600.0, 700.0, 800.0)
"""The benchmark's segments."""

SHORT_LENGTHS_M: Final = (50.0, 100.0)
"""Segments of a drive that has no room for the benchmark's longest one."""

KITTI_STEP_FRAMES: Final = 10
"""The benchmark starts a segment at every tenth frame (one second)."""

MIN_PATH_M: Final = 1.0
"""Errors relative to a shorter path would be the truth's own noise."""


@dataclass(frozen=True, eq=False)
class Segments:
    """Stretches of the true path.

    Attributes:
        first: int32 (N,), frame at which each begins.
        last: int32 (N,), frame at which each ends.
        length_m: float64 (N,), nominal length of each.
    """

    first: Int32
    last: Int32
    length_m: Float64


def evaluate_trajectory(estimate: Trajectory, truth: Trajectory) -> TrajectoryMetrics:
    """Compare an estimated trajectory with the true one, pose by pose.

    Relative errors follow the KITTI development kit: segments of 100 to 800 m of the true path,
    one at every tenth frame; the error of a segment is the error of the motion over it, divided
    by its length; the mean is over all segments. A drive under 800 m has segments of 50 and
    100 m instead, starting at every frame, and one of 50 m or less has segments of half its
    path: `TrajectoryMetrics.segment_lengths_m` tells which were used.

    Args:
        estimate: One pose for each true pose; its first pose may differ, for relative errors do
            not see it and the absolute error is measured after alignment.
        truth: The true poses.

    Returns:
        The figures; every one is finite.

    Raises:
        EvaluationError: The lengths differ, there are fewer than two poses, or the true path is
            shorter than `MIN_PATH_M`.

    Ref:
        Geiger, Lenz, Urtasun, "Are we ready for autonomous driving?", CVPR 2012;
        Sturm et al., "A benchmark for the evaluation of RGB-D SLAM systems", IROS 2012.
    """
    _check(estimate, truth)
    segments = choose_segments(truth.distances_m)
    translation_m, rotation_rad = motion_errors(estimate, truth, segments.first, segments.last)
    frames = np.arange(len(truth), dtype=np.int32)
    step_m, step_rad = motion_errors(estimate, truth, frames[:-1], frames[1:])
    return TrajectoryMetrics(
        t_rel_percent=100.0 * float(np.mean(translation_m / segments.length_m)),
        r_rel_deg_per_100m=100.0 * float(np.mean(np.rad2deg(rotation_rad) / segments.length_m)),
        ate_m=_rms(_aligned_distances_m(estimate.positions_m, truth.positions_m)),
        rpe_m=_rms(step_m),
        rpe_deg=float(np.rad2deg(_rms(step_rad))),
        path_length_m=truth.path_length_m,
        frames=len(truth),
        segment_lengths_m=tuple(float(length) for length in np.unique(segments.length_m)),
        segments=len(segments.first),
    )


def choose_segments(distances_m: Float64) -> Segments:
    """The segments over which a drive is judged.

    Args:
        distances_m: float64 (N,), true path length from the first pose to each.
    """
    path_m = float(distances_m[-1])
    if path_m >= KITTI_LENGTHS_M[-1]:
        return segments_of(distances_m, KITTI_LENGTHS_M, KITTI_STEP_FRAMES)
    segments = segments_of(distances_m, SHORT_LENGTHS_M, 1)
    return segments if len(segments.first) else segments_of(distances_m, (0.5 * path_m,), 1)


def segments_of(distances_m: Float64, lengths_m: tuple[float, ...], step: int) -> Segments:
    """Segments of given lengths from every ``step``-th frame, where the path has room for them.

    As in the development kit, a segment ends at the first frame that lies farther along the
    path than its length.
    """
    starts = np.arange(0, len(distances_m), step)
    first = np.repeat(starts, len(lengths_m))
    length_m = np.tile(np.asarray(lengths_m, dtype=np.float64), len(starts))
    last = np.searchsorted(distances_m, distances_m[first] + length_m, side="right")
    fits = last < len(distances_m)
    return Segments(first[fits].astype(np.int32), last[fits].astype(np.int32), length_m[fits])


def motion_errors(
    estimate: Trajectory, truth: Trajectory, first: Int32, last: Int32
) -> tuple[Float64, Float64]:
    """Errors of the motion between two frames.

    Returns:
        Translation in metres (N,) and rotation in radians (N,).
    """
    wrong = invert(_motion(estimate, first, last)) @ _motion(truth, first, last)
    return np.linalg.norm(wrong[:, :3, 3], axis=1), angle_rad(wrong)


def _motion(trajectory: Trajectory, first: Int32, last: Int32) -> Float64:
    """Float64 (N, 4, 4), poses of the last frames in axes of the first ones."""
    poses = trajectory.T_world_camera
    motion: Float64 = invert(poses[first]) @ poses[last]
    return motion


def _aligned_distances_m(estimate_m: Float64, truth_m: Float64) -> Float64:
    """Distances (N,) of positions after the rigid motion that brings them closest (Umeyama)."""
    estimate_m = estimate_m - estimate_m.mean(axis=0)
    truth_m = truth_m - truth_m.mean(axis=0)
    U, _, Vt = np.linalg.svd(truth_m.T @ estimate_m)
    U[:, -1] *= np.sign(np.linalg.det(U @ Vt))
    distances: Float64 = np.linalg.norm(truth_m - estimate_m @ (U @ Vt).T, axis=1)
    return distances


def _rms(values: Float64) -> float:
    return float(np.sqrt(np.mean(np.square(values))))


def _check(estimate: Trajectory, truth: Trajectory) -> None:
    if len(estimate) != len(truth):
        raise EvaluationError(
            "estimated and true trajectory differ in length",
            got=f"{len(estimate)} poses",
            expected=f"{len(truth)} poses",
            hint="both must list a pose for the same frames",
        )
    if len(truth) < 2:
        raise EvaluationError(
            "too few poses to compare", got=f"{len(truth)} poses", expected="2 or more"
        )
    if truth.path_length_m < MIN_PATH_M:
        raise EvaluationError(
            "true path is too short for errors relative to its length",
            got=f"{truth.path_length_m:.2f} m",
            expected=f"{MIN_PATH_M:g} m or more",
        )
