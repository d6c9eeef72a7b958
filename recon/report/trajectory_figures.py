"""Figures of a trajectory compared with ground truth. All return PNG bytes."""

from __future__ import annotations

from typing import Final

import numpy as np

from recon.core.values.arrays import Float64
from recon.evaluation import TrajectoryComparison
from recon.report.canvas import (
    ESTIMATE,
    FAINT,
    HALF_IN,
    TRUTH,
    WIDE_IN,
    new_figure,
    style_plot,
    to_png,
)
from recon.report.plots import height_for, mark_ends

_NAMES: Final = ("x", "y", "z")


def paths_figure(comparison: TrajectoryComparison) -> bytes:
    """Both paths, projected on the two world axes along which the true one extends farthest."""
    across, up = widest_axes(comparison.truth.positions_m)
    drawn = [path.positions_m[:, [across, up]] for path in (comparison.truth, comparison.estimate)]
    figure = new_figure(WIDE_IN, height_for(np.concatenate(drawn)))
    axes = figure.subplots()
    axes.plot(*drawn[0].T, color=TRUTH, linewidth=3.5, alpha=0.75, label="truth")
    axes.plot(*drawn[1].T, color=ESTIMATE, linewidth=1.8, label="estimate")
    mark_ends(axes, drawn[0])
    style_plot(axes, f"{_NAMES[across]} (m)", f"{_NAMES[up]} (m)")
    axes.set_aspect("equal", adjustable="datalim")
    axes.legend(loc="best", frameon=False)
    return to_png(figure)


def errors_along_figure(comparison: TrajectoryComparison) -> bytes:
    """Position and rotation error of each aligned pose, along the true path."""
    truth = comparison.truth
    figure = new_figure(WIDE_IN, 4.6)
    upper, lower = figure.subplots(2, 1, sharex=True)
    upper.plot(truth.distances_m, comparison.position_errors_m, color=ESTIMATE)
    upper.axhline(comparison.metrics.ate_m, color=FAINT, linestyle="--", label="root mean square")
    upper.legend(loc="best", frameon=False)
    lower.plot(truth.distances_m, np.degrees(comparison.rotation_errors_rad), color=ESTIMATE)
    for axes in (upper, lower):
        axes.set_ylim(bottom=0)
    style_plot(upper, "", "position error (m)")
    style_plot(lower, "distance along the true path (m)", "rotation error (°)")
    return to_png(figure)


def errors_by_length_figure(comparison: TrajectoryComparison, *, rotation: bool) -> bytes:
    """Relative error of the segments by length: mean and interquartile range."""
    values = comparison.segment_deg_per_100m if rotation else comparison.segment_percent
    label = "rotation error (°/100 m)" if rotation else "translation error (%)"
    lengths = np.unique(comparison.segments.length_m)
    groups = [values[comparison.segments.length_m == length] for length in lengths]
    quarters = np.array([np.percentile(group, (25, 75)) for group in groups])
    figure = new_figure(HALF_IN, 3.4)
    axes = figure.subplots()
    # One bar per length, as a line shows nothing for one or two lengths.
    axes.vlines(lengths, *quarters.T, color=ESTIMATE, alpha=0.35, linewidth=8)
    means = [float(np.mean(group)) for group in groups]
    axes.plot(lengths, means, "o-", color=ESTIMATE, markersize=6)
    margin = max(10.0, 0.05 * float(np.ptp(lengths)))
    axes.set_xlim(max(0.0, lengths[0] - margin), lengths[-1] + margin)
    axes.set_ylim(bottom=0)
    style_plot(axes, "length of the segments (m)", label)
    return to_png(figure)


def widest_axes(positions_m: Float64) -> tuple[int, int]:
    """The two axes along which a path extends farthest, in order of the axes."""
    first, second = sorted(np.argsort(-np.ptp(positions_m, axis=0), kind="stable")[:2].tolist())
    return first, second
