"""The report of a trajectory compared with ground truth."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Final

from recon.evaluation.trajectory_run import TrajectoryRun
from recon.io.atomic import write_bytes, write_text
from recon.report.blocks import metrics_table
from recon.report.html import FigureBlock, ReportContent, Section, TableBlock, render_html
from recon.report.present import command_line
from recon.report.trajectory_figures import (
    errors_along_figure,
    errors_by_length_figure,
    paths_figure,
)
from recon.run.directory import RunDirectory
from recon.run.machine import versions

_ALIGNED: Final[Mapping[str, str]] = {
    "none": "Nothing is aligned.",
    "origin": "The estimate is moved so that both begin in the same pose.",
    "se3": "The estimate is moved as a whole (rotation, translation) to lie closest.",
    "sim3": "The estimate is moved and scaled as a whole to lie closest.",
}


def present_trajectory(run: TrajectoryRun, directory: RunDirectory) -> None:
    """Write ``report.html`` of a comparison, and its figures as PNG files.

    Raises:
        OutputError: A file cannot be written.
    """
    figures = {
        "path": paths_figure(run.comparison),
        "error_along_path": errors_along_figure(run.comparison),
        "translation_by_length": errors_by_length_figure(run.comparison, rotation=False),
        "rotation_by_length": errors_by_length_figure(run.comparison, rotation=True),
    }
    for name, png in figures.items():
        write_bytes(directory.path(f"{name}.png"), png)
    write_text(directory.path("report.html"), render_html(_content(run, figures)))


def _roll_note(run: TrajectoryRun) -> str:
    if run.comparison.roll_axis is None:
        return ""
    return (
        " The path is straight, so its positions do not fix the roll about it: the rotation error "
        "is without a roll common to all poses, which cannot be observed here."
    )


def _content(run: TrajectoryRun, figures: Mapping[str, bytes]) -> ReportContent:
    found = run.comparison.metrics
    spread = "Dots are means, bars the middle half of the segments."
    sections = (
        Section("Paths", [
            FigureBlock("From above", figures["path"], _ALIGNED[found.alignment]),
            FigureBlock("Error along the path", figures["error_along_path"],
                        f"Of each pose, after the alignment.{_roll_note(run)}"),
        ]),
        Section("Relative errors", [
            FigureBlock("Translation", figures["translation_by_length"], spread, wide=False),
            FigureBlock("Rotation", figures["rotation_by_length"], spread, wide=False),
            _lengths_table(run),
            metrics_table(found),
        ]),
    )  # fmt: skip
    return ReportContent(
        title=f"{run.estimate.name} against {run.truth.name}",
        subtitle=f"{found.frames} poses compared {run.summary['associated']}, "
        f"{found.path_length_m:.1f} m of true path",
        command=command_line(),
        warnings=run.summary["warnings"],
        figures=[
            ("Drift (t_rel)", f"{found.t_rel_percent:.2f} %"),
            ("Rotation drift (r_rel)", f"{found.r_rel_deg_per_100m:.2f} °/100 m"),
            ("Position error (ATE)", f"{found.ate_m:.3f} m"),
            ("Scale", f"{found.scale:.4f}"),
        ],
        sections=sections,
        versions=versions(),
    )


def _lengths_table(run: TrajectoryRun) -> TableBlock:
    rows = [
        (
            f"{one.length_m:g} m",
            f"{one.t_rel_percent:.3f}",
            f"{one.r_rel_deg_per_100m:.3f}",
            str(one.segments),
        )
        for one in run.comparison.metrics.by_length
    ]
    header = ("length", "translation (%)", "rotation (°/100 m)", "segments")
    return TableBlock("By length of the segments", header, rows)
