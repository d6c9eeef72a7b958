"""The report of a drive located in a map."""

from __future__ import annotations

from typing import Final

import numpy as np

from recon.map.localize.localizer import State
from recon.map.localize.sequence import LocalizedDrive, LocalizeRun
from recon.report import style
from recon.report.drive_figures import grid_figure, path_figure, seen_from_above
from recon.report.page import write_page
from recon.run.directory import RunDirectory

_SHADES: Final = {State.SEARCHING: style.FAINT, State.COASTING: style.TRUTH, State.LOST: style.BAD}


def write_localize_page(result: LocalizeRun, run: RunDirectory) -> None:
    """Write ``report.html`` of a drive in a map."""
    figures = {"path": _path(result), "certainty": certainty_figure(result.drive)}
    write_page("localize", run, result.summary, result=result, figures=figures)


def _path(result: LocalizeRun) -> bytes | None:
    """Return the path on the grid, or alone if the map has none; None where there is neither."""
    path, T_map_world = result.drive.trajectory, result.drive.T_map_world
    if result.grid is not None:
        return grid_figure(result.grid, {"path": seen_from_above(path, T_map_world)})
    return path_figure(path, None, T_map_world) if len(path) else None


@style.styled
def certainty_figure(drive: LocalizedDrive) -> bytes:
    """Draw standard deviations of each pose, and what confirms it; the others are shaded."""
    known = [frame.located for frame in drive.frames]
    inliers = [float(x.inliers) if x.covariance is not None else np.nan for x in known]
    labels = ("standard deviation\nof the position (m)", "features that\nagree")
    figure, rows = style.stacked(4.4, "frame", labels)
    for axes, values in zip(rows, ([x.sigma_m for x in known], inliers), strict=True):
        axes.plot(values, marker=".")
        axes.set_ylim(bottom=0)
        axes.set_xlim(-0.5, len(known) - 0.5)
        for state, colour in _SHADES.items():
            style.shade(axes, [n for n, x in enumerate(known) if x.state == state], 1.0, colour)
    figure.align_ylabels()
    return style.to_png(figure)
