"""Figures of a calibration: board coverage, error of each view, and depth error."""

from __future__ import annotations

import numpy as np
from matplotlib.axes import Axes

from recon.report.canvas import (
    BAD,
    ESTIMATE,
    FAINT,
    HALF_IN,
    INK,
    TRUTH,
    WIDE_IN,
    new_figure,
    style_plot,
    to_png,
)
from recon.rig.calibrate import DepthError
from recon.rig.calibrate.bootstrap import CONFIDENCE, MATCH_SIGMA_PX
from recon.rig.calibrate.result import CalibrationRun

_CELLS = (8, 6)


def coverage_figure(run: CalibrationRun) -> bytes:
    """PNG of all detected corners in both images, over the cells of the coverage measure."""
    width, height = run.seen.size_px
    figure = new_figure(WIDE_IN, WIDE_IN / 2 * height / width + 0.5)
    for side, axes in enumerate(figure.subplots(1, 2)):
        name = ("left", "right")[side]
        for view in run.fit.views:
            pixels = view.seen[side].pixels
            axes.plot(*pixels.T, ".", markersize=3.5, alpha=0.8)
        share = run.summary[f"coverage_{name}"]
        _frame(axes, width, height, f"{name.capitalize()}: {100 * share:.0f} % of the cells")
    return to_png(figure)


def errors_figure(run: CalibrationRun) -> bytes:
    """PNG of the RMS error of each view in both images, including dropped views."""
    names = [*(view.name for view in run.fit.views), *run.fit.dropped]
    used = len(run.fit.views)
    figure = new_figure(WIDE_IN, 3.4)
    axes = figure.subplots()
    place = np.arange(used)
    axes.bar(place - 0.2, run.fit.errors_px[:, 0], 0.38, color=ESTIMATE, label="left")
    axes.bar(place + 0.2, run.fit.errors_px[:, 1], 0.38, color=TRUTH, label="right")
    if run.fit.dropped:
        gone = np.arange(used, len(names))
        axes.bar(gone, list(run.fit.dropped.values()), 0.6, color=BAD, label="dropped")
        axes.set_yscale("log")
    axes.axhline(run.fit.rms_px, color=INK, linewidth=1, linestyle="--")
    style_plot(axes, "", "rms error, px")
    axes.set_xticks(np.arange(len(names)), names, rotation=60, ha="right", fontsize=7)
    axes.legend(frameon=False, ncols=3)
    return to_png(figure)


def rows_figure(run: CalibrationRun) -> bytes:
    """PNG of the row differences of the corners after rectification."""
    figure = new_figure(HALF_IN, 3.4)
    axes = figure.subplots()
    reach = max(float(np.quantile(np.abs(run.rows_px), 0.999)), 0.05)
    axes.hist(run.rows_px, bins=list(np.linspace(-reach, reach, 61)), color=ESTIMATE)
    axes.axvline(0, color=INK, linewidth=1)
    style_plot(axes, "row left − row right, px", "corners")
    return to_png(figure)


def depth_error_figure(run: CalibrationRun) -> bytes:
    """PNG of the depth error by depth: from matching, and from calibration with its interval."""
    known = [each for each in run.spread.depths if np.isfinite(each.calibration_m)]
    figure = new_figure(HALF_IN, 3.4)
    axes = figure.subplots()
    depths = [each.depth_m for each in run.spread.depths]
    matching = [100 * each.matching_m for each in run.spread.depths]
    axes.plot(depths, matching, "o-", color=FAINT, label=_matching_label())
    axes.plot(
        [each.depth_m for each in known],
        [100 * each.calibration_m for each in known],
        "o-",
        color=ESTIMATE,
        label="calibration, over the picture",
    )
    axes.fill_between(
        [each.depth_m for each in known],
        [1e-3] * len(known),
        [_reach_cm(each) for each in known],
        color=ESTIMATE,
        alpha=0.15,
        linewidth=0,
        label=f"{100 * CONFIDENCE:.0f} % interval, middle of the picture",
    )
    axes.set_xscale("log")
    axes.set_yscale("log")
    low = min([*matching, *(100 * each.calibration_m for each in known)])
    axes.set_ylim(bottom=max(low / 3, 1e-3))
    style_plot(axes, "depth, m", "depth error, cm")
    axes.set_xticks(depths, [f"{depth:g}" for depth in depths])
    axes.minorticks_off()
    axes.legend(frameon=False, fontsize=8)
    return to_png(figure)


def _reach_cm(each: DepthError) -> float:
    return 100 * max(abs(each.low_m), abs(each.high_m))


def _matching_label() -> str:
    return f"matching to {MATCH_SIGMA_PX:g} px"


def _frame(axes: Axes, width: int, height: int, title: str) -> None:
    axes.set_title(title, loc="left", fontsize=11, color=INK)
    axes.set_xlim(-0.5, width - 0.5)
    axes.set_ylim(height - 0.5, -0.5)
    axes.set_aspect("equal")
    axes.set_xticks(np.linspace(0, width, _CELLS[0] + 1)[1:-1], [])
    axes.set_yticks(np.linspace(0, height, _CELLS[1] + 1)[1:-1], [])
    axes.grid(visible=True, color="#d8dee4", linewidth=0.8)
    axes.tick_params(length=0)
    for spine in axes.spines.values():
        spine.set_color(FAINT)
