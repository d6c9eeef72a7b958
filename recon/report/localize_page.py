"""The report of a drive located in a map."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Final

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure

from recon.map.localize.localizer import State
from recon.map.localize.sequence import LocalizedDrive, LocalizeRun
from recon.report.drive_figures import grid_figure, path_figure, seen_from_above
from recon.report.page import write_page
from recon.report.style import BAD, FAINT, TRUTH, WIDE_IN, styled, to_png
from recon.run.directory import RunDirectory

_SHADES: Final = {State.SEARCHING: FAINT, State.COASTING: TRUTH, State.LOST: BAD}


def write_localize_page(result: LocalizeRun, run: RunDirectory) -> None:
    """Write ``report.html`` of a drive in a map."""
    figures = {"path": _path(result), "certainty": certainty_figure(result.drive)}
    write_page("localize", run, run=result, figures=figures, warnings=result.summary["warnings"])


def _path(result: LocalizeRun) -> bytes | None:
    """Return the path on the grid, or alone if the map has none; None where there is neither."""
    path, T_map_world = result.drive.trajectory, result.drive.T_map_world
    if result.grid is not None:
        return grid_figure(result.grid, {"path": seen_from_above(path, T_map_world)})
    return path_figure(path, None, T_map_world) if len(path) else None


@styled
def certainty_figure(drive: LocalizedDrive) -> bytes:
    """Return standard deviations of each pose, and what confirms it; the others are shaded."""
    known = [frame.located for frame in drive.frames]
    sigmas_m = [located.sigma_m for located in known]
    inliers = [float(x.inliers) if x.covariance is not None else np.nan for x in known]
    figure = Figure((WIDE_IN, 4.4))
    upper, lower = figure.subplots(2, 1, sharex=True)
    upper.plot(sigmas_m, marker=".")
    lower.plot(inliers, marker=".")
    upper.set(ylabel="standard deviation\nof the position (m)")
    lower.set(ylabel="features that\nagree", xlabel="frame")
    for axes in (upper, lower):
        axes.set_ylim(bottom=0)
        axes.set_xlim(-0.5, len(known) - 0.5)
        _shade(axes, [located.state for located in known])
    figure.align_ylabels()
    return to_png(figure)


def _shade(axes: Axes, states: Sequence[State]) -> None:
    """Mark the frames whose pose nothing confirms."""
    for number, state in enumerate(states):
        if state in _SHADES:
            ends = (number - 0.5, number + 0.5)
            axes.axvspan(*ends, color=_SHADES[state], alpha=0.2, linewidth=0)
