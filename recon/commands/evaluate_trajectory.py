"""`recon evaluate trajectory`: compare two trajectory files."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np

from recon.core.text import counted
from recon.core.values import Trajectory
from recon.evaluation.doubts import doubts_of_file
from recon.evaluation.segments import TOLERANCE_S, associate, interpolation_warnings
from recon.evaluation.trajectory import TrajectoryRules, TrajectoryRun, compare_paths
from recon.io.trajectory import holds_times, read_trajectory, write_tum
from recon.report.trajectory_page import write_trajectory_page
from recon.run.run import Run
from recon.run.summary import plain
from recon.sources.times import read_times


def run_evaluate_trajectory(
    estimate: Path,
    truth: Path,
    rules: TrajectoryRules,
    *,
    times: Path | None = None,
    tolerance_s: float = TOLERANCE_S,
    out: Path | None = None,
) -> dict[str, Any]:
    """Compare two trajectory files: what `recon evaluate trajectory` does.

    Poses are associated by time if both files have timestamps, else in order; the paths are
    aligned as the rules say. With a folder, the aligned paths and a report go there.

    Args:
        estimate: KITTI or TUM file.
        truth: Ground truth, KITTI or TUM file.
        rules: How the two are aligned and compared.
        times: Timestamps of the poses of a KITTI file in seconds, one per line; None = unknown.
        tolerance_s: Largest time difference of two associated poses.
        out: Result folder; None = nothing is written.
    """
    ours, true, by_time = _read_paths(estimate, truth, times)
    poses = {"estimate_poses": len(ours), "true_poses": len(true)}
    if by_time:
        ours, true = associate(ours, true, tolerance_s)
    comparison = compare_paths(ours, true, rules)
    summary = {
        **plain(comparison.metrics),
        "T_truth_estimate": comparison.motion.T_to_from.tolist(),
        "rotation_deg": float(np.degrees(np.sqrt((comparison.rotation_errors_rad**2).mean()))),
        "roll": "fixed" if comparison.roll_axis is None else "not observable on a straight path",
        "associated": "by time" if by_time else "in order",
        **poses,
        "warnings": [
            *doubts_of_file(estimate),
            *_warnings(len(true), min(poses.values())),
            *interpolation_warnings(comparison.truth, comparison.segments),
        ],
    }
    if out is not None:
        with Run("evaluate trajectory", out) as run:
            write_tum(run.path("estimate_aligned_tum.txt"), comparison.estimate)
            write_tum(run.path("truth_tum.txt"), comparison.truth)
            with run.report(summary):
                write_trajectory_page(TrajectoryRun(estimate, truth, comparison, summary), run)
            inputs = [path for path in (estimate, truth, times) if path is not None]
            run.finish(summary, source=str(estimate), inputs=inputs)
    return summary


def _read_paths(
    estimate: Path, truth: Path, times: Path | None
) -> tuple[Trajectory, Trajectory, bool]:
    """Estimate and truth, and whether the times of both are known."""
    stamped = [holds_times(path) for path in (estimate, truth)]
    paths = [read_trajectory(path) for path in (estimate, truth)]
    if times is not None:
        for n, path in enumerate(paths):
            if not stamped[n]:
                paths[n] = Trajectory(path.T_world_camera, read_times(times, len(path)))
        stamped = [True, True]
    return paths[0], paths[1], all(stamped)


def _warnings(compared: int, fewer: int) -> list[str]:
    if 2 * compared >= fewer:
        return []
    return [f"a partner in time for only {compared} of {counted(fewer, 'pose')}; see --tolerance"]
