"""`recon evaluate trajectory` without its command line: compare two trajectory files."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, Final

import numpy as np

from recon.core.values import Trajectory
from recon.evaluation import TrajectoryComparison, TrajectoryRules, associate, compare_paths
from recon.io.trajectory import holds_times, read_trajectory, write_tum
from recon.run.directory import RunDirectory
from recon.run.record import fingerprint, write_record
from recon.run.summary import plain
from recon.sources.times import read_times

TOLERANCE_S: Final = 0.01
"""Largest time difference of two associated poses."""


@dataclass(frozen=True)
class TrajectoryFiles:
    """The trajectories to compare.

    Attributes:
        estimate: KITTI or TUM file.
        truth: Ground truth, KITTI or TUM file.
        times: Timestamps of the poses of a KITTI file in seconds, one per line; None = unknown.
        tolerance_s: Largest time difference of two associated poses.
    """

    estimate: Path
    truth: Path
    times: Path | None = None
    tolerance_s: float = TOLERANCE_S


@dataclass(frozen=True, eq=False)
class TrajectoryRun:
    """The result of a comparison, from which its report is made.

    Attributes:
        files: What was compared.
        comparison: The two paths, aligned, and their differences.
        summary: The figures of ``summary.json``.
    """

    files: TrajectoryFiles
    comparison: TrajectoryComparison
    summary: dict[str, Any] = field(default_factory=dict)


Present = Callable[[TrajectoryRun, RunDirectory], None]


def run_evaluate_trajectory(
    files: TrajectoryFiles,
    rules: TrajectoryRules,
    out: Path | None = None,
    present: Present | None = None,
) -> dict[str, Any]:
    """Compare two trajectory files; with a folder, write figures and report into it.

    Poses are associated by time if both files have timestamps, else in order.

    Raises:
        ReconError: A file cannot be read, the two cannot be compared, or the folder cannot be
            written; then no output is left behind.
    """
    estimate, truth, by_time = _read_paths(files)
    poses = {"estimate_poses": len(estimate), "true_poses": len(truth)}
    if by_time:
        estimate, truth = associate(estimate, truth, files.tolerance_s)
    comparison = compare_paths(estimate, truth, rules)
    summary = {
        **plain(comparison.metrics),
        "rotation_deg": float(np.degrees(np.sqrt((comparison.rotation_errors_rad**2).mean()))),
        "roll": "fixed" if comparison.roll_axis is None else "not observable on a straight path",
        "associated": "by time" if by_time else "in order",
        **poses,
        "warnings": _warnings(len(truth), poses),
    }
    if out is not None:
        _write(TrajectoryRun(files, comparison, summary), out, present)
    return summary


def _read_paths(files: TrajectoryFiles) -> tuple[Trajectory, Trajectory, bool]:
    """Estimate and truth, and whether the times of both are known."""
    stamped = [holds_times(path) for path in (files.estimate, files.truth)]
    paths = [read_trajectory(path) for path in (files.estimate, files.truth)]
    if files.times is not None:
        for n, path in enumerate(paths):
            if not stamped[n]:
                times_s = read_times(files.times, len(path))
                paths[n] = Trajectory(path.T_world_camera, times_s)
        stamped = [True, True]
    return paths[0], paths[1], all(stamped)


def _warnings(compared: int, poses: dict[str, int]) -> list[str]:
    fewer = min(poses.values())
    if 2 * compared >= fewer:
        return []
    return [f"only {compared} of {fewer} poses have a partner in time; see --tolerance"]


def _write(run: TrajectoryRun, out: Path, present: Present | None) -> None:
    with RunDirectory.for_command("evaluate", out) as directory:
        write_tum(directory.path("estimate_aligned_tum.txt"), run.comparison.estimate)
        write_tum(directory.path("truth_tum.txt"), run.comparison.truth)
        run.summary["out"] = str(directory.folder)
        if present is not None:
            present(run, directory)
        directory.write_json("summary.json", run.summary)
        read = [run.files.estimate, run.files.truth, run.files.times]
        inputs = fingerprint([path for path in read if path is not None])
        content = {"source": str(run.files.estimate), "inputs": inputs}
        write_record(directory, "evaluate trajectory", content)
