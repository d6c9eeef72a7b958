"""The report of a trajectory compared with ground truth."""

from __future__ import annotations

from recon.evaluation.trajectory import TrajectoryRun
from recon.io.atomic import write_bytes
from recon.report.drive_figures import (
    compared_paths_figure,
    errors_by_length_figure,
    pose_errors_figure,
)
from recon.report.page import write_page
from recon.run.directory import RunDirectory


def write_trajectory_page(result: TrajectoryRun, run: RunDirectory) -> None:
    """Write ``report.html`` of a comparison, and its figures as PNG files."""
    figures = {
        "path": compared_paths_figure(result.comparison),
        "error_along_path": pose_errors_figure(result.comparison),
        "translation_by_length": errors_by_length_figure(result.comparison, rotation=False),
        "rotation_by_length": errors_by_length_figure(result.comparison, rotation=True),
    }
    for name, png in figures.items():
        write_bytes(run.path(f"{name}.png"), png)
    warnings = result.summary["warnings"]
    write_page("trajectory", run, run=result, figures=figures, warnings=warnings)
