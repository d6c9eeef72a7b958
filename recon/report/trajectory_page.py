"""The report of a trajectory compared with ground truth."""

from __future__ import annotations

import numpy as np

from recon.core.values.arrays import Float64
from recon.evaluation.trajectory import TrajectoryComparison, TrajectoryRun
from recon.io.atomic import write_bytes
from recon.report import style
from recon.report.drive_figures import ESTIMATE_LINE, TRUTH_LINE, errors_along, top_view
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
    write_page("trajectory", run, result.summary, result=result, figures=figures)


def compared_paths_figure(comparison: TrajectoryComparison) -> bytes:
    """Draw both paths on the two world axes along which the true one extends farthest."""
    axes = widest_axes(comparison.truth.positions_m)
    paths = (comparison.truth, comparison.estimate)
    truth, estimate = (path.positions_m[:, axes] for path in paths)
    first, second = (f"{'xyz'[axis]} (m)" for axis in axes)
    return top_view([(truth, TRUTH_LINE), (estimate, ESTIMATE_LINE)], truth, (first, second))


@style.styled
def pose_errors_figure(comparison: TrajectoryComparison) -> bytes:
    """Draw position and rotation error of each aligned pose, along the true path."""
    degrees = np.degrees(comparison.rotation_errors_rad)
    figure, (upper, _) = errors_along(comparison.truth, comparison.position_errors_m, degrees)
    upper.axhline(
        comparison.metrics.ate_m, color=style.FAINT, linestyle="--", label="root mean square"
    )
    upper.legend(loc="best")
    return style.to_png(figure)


@style.styled
def errors_by_length_figure(comparison: TrajectoryComparison, *, rotation: bool) -> bytes:
    """Draw the relative error of the segments by length: mean and interquartile range."""
    values = comparison.segment_deg_per_100m if rotation else comparison.segment_percent
    lengths = np.unique(comparison.segments.length_m)
    groups = [values[comparison.segments.length_m == length] for length in lengths]
    quarters = np.array([np.percentile(group, (25, 75)) for group in groups])
    figure, axes = style.subplots(style.HALF_IN, 3.4)
    # One bar per length, as a line shows nothing for one or two lengths.
    axes.vlines(lengths, *quarters.T, color=style.ESTIMATE, alpha=0.35, linewidth=8)
    axes.plot(lengths, [float(np.mean(group)) for group in groups], "o-")
    margin = max(10.0, 0.05 * float(np.ptp(lengths)))
    axes.set_xlim(max(0.0, lengths[0] - margin), lengths[-1] + margin)
    label = "rotation error (°/100 m)" if rotation else "translation error (%)"
    axes.set(xlabel="length of the segments (m)", ylabel=label, ylim=(0, None))
    return style.to_png(figure)


def widest_axes(positions_m: Float64) -> list[int]:
    """Return the two axes along which a path extends farthest, in order of the axes."""
    return sorted(np.argsort(-np.ptp(positions_m, axis=0), kind="stable")[:2].tolist())
