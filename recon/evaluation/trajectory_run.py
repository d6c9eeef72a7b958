"""The result of comparing two trajectory files, from which its report is made."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import Any

from recon.evaluation.trajectory import TrajectoryComparison


@dataclass(frozen=True, eq=False)
class TrajectoryRun:
    """The result of a comparison.

    Attributes:
        estimate: File of the estimate.
        truth: File of the ground truth.
        comparison: The two paths, aligned, and their differences.
        summary: The figures of ``summary.json``.
    """

    estimate: Path
    truth: Path
    comparison: TrajectoryComparison
    summary: dict[str, Any]
