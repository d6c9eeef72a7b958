"""The tables, the plot of a sweep and the report of a batch."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any, Final

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure

from recon.io.atomic import write_bytes, write_text
from recon.report.page import write_page
from recon.report.style import WIDE_IN, styled, to_png
from recon.report.table import NOT_KNOWN, Table, csv_text, join
from recon.run.batch.figures import JobResult, outliers_first
from recon.run.directory import RunDirectory

#: Columns of the tables for people, where any job has them; the CSV has every figure.
_COLUMNS: Final = (
    "frames", "path_length_m", "frames_not_trusted", "trajectory.t_rel_percent", "trajectory.ate_m",
    "map.f_score", "t_rel_percent", "f_score", "disparity.bad.2.0", "bad.2.0", "valid_percent",
    "points", "peak_memory_mb",
)  # fmt: skip
#: What a sweep is judged by: the first that its jobs have.
_ACCURACY: Final = (
    "trajectory.t_rel_percent", "map.f_score", "t_rel_percent", "f_score", "disparity.bad.2.0",
    "bad.2.0", "valid_percent", "points",
)  # fmt: skip


def write_batch_page(
    results: Sequence[JobResult], summary: Mapping[str, Any], run: RunDirectory
) -> None:
    """Write the table as CSV and Markdown, and ``report.html`` with the outliers first.

    Args:
        results: The jobs, in the order of the batch.
        summary: The content of ``summary.json``.
        run: The run of the batch.

    Raises:
        OutputError: A file cannot be written.
    """
    table = batch_table(results)
    write_text(run.path("table.csv"), batch_csv(results))
    write_text(run.path("table.md"), join([table.markdown()]))
    sweep = sweep_figure(results) if any(one.job.swept for one in results) else b""
    if sweep:
        write_bytes(run.path("sweep.png"), sweep)
    failed = [f"{one.job.name}: {one.error}" for one in results if one.state == "failed"]
    write_page(
        "batch",
        run,
        found=summary,
        head=table.head,
        jobs=[
            {
                "name": one.job.name,
                "page": _page(one, run.folder),
                "cells": cells[1:],
                "why": why,
            }
            for one, cells, why in _ranked(results)
        ],
        sweep=sweep,
        warnings=[*failed, *summary["warnings"]],
    )


def batch_table(results: Sequence[JobResult]) -> Table:
    """Return the table for people: one row per job, with the figures that its kind has."""
    columns = [name for name in _COLUMNS if any(name in one.figures for one in results)]
    rows = [
        (one.job.name, one.state, str(one.tries), f"{one.seconds:.1f}", *_cells(one, columns))
        for one in results
    ]
    return Table("Jobs", ("job", "state", "tries", "seconds", *columns), rows)


def batch_csv(results: Sequence[JobResult]) -> str:
    """Return the table for programs: every swept setting and every figure of every job."""
    swept = list(dict.fromkeys(key for one in results for key in one.job.swept))
    names = list(dict.fromkeys(key for one in results for key in one.figures))
    head = ["job", "command", "source", "state", "tries", "seconds", "error", *swept, *names]
    rows = [
        [
            one.job.name, one.job.command, one.job.source, one.state, one.tries, one.seconds,
            one.error, *(one.job.swept.get(key, "") for key in swept),
            *(one.figures.get(key, "") for key in names),
        ]
        for one in results
    ]  # fmt: skip
    return csv_text([head, *rows])


@styled
def sweep_figure(results: Sequence[JobResult]) -> bytes:
    """Draw accuracy and time over each swept setting: a point per job, a line through the medians.

    Empty if no job succeeded.
    """
    done = [one for one in results if one.figures and one.job.swept]
    settings = list(dict.fromkeys(key for one in done for key in one.job.swept))
    accuracy = next((name for name in _ACCURACY if any(name in one.figures for one in done)), None)
    if not settings:
        return b""
    shown = [name for name in (accuracy, "seconds") if name is not None]
    figure = Figure((WIDE_IN, 3.2 * len(settings)))
    panels = figure.subplots(len(settings), len(shown), squeeze=False)
    for row, setting in zip(panels, settings, strict=True):
        for axes, name in zip(row, shown, strict=True):
            _draw(axes, done, setting, name)
    return to_png(figure)


def _draw(axes: Axes, done: Sequence[JobResult], setting: str, name: str) -> None:
    values = list(dict.fromkeys(one.job.swept[setting] for one in done if setting in one.job.swept))
    found = [
        [
            one.figures[name] for one in done
            if one.job.swept.get(setting) == value and name in one.figures
        ]
        for value in values
    ]  # fmt: skip
    for place, figures in enumerate(found):
        axes.plot([place] * len(figures), figures, "o", color="C0", markersize=4, alpha=0.5)
    medians = [float(np.median(figures)) if figures else np.nan for figures in found]
    axes.plot(range(len(values)), medians, "-", color="C1", label="median")
    axes.set_xticks(range(len(values)), [str(value) for value in values])
    axes.set(xlabel=setting, ylabel=name)
    axes.legend()


def _page(one: JobResult, folder: Path) -> str:
    """Return the page to look at in the folder of a job; "" = it has no result."""
    if one.state != "succeeded":
        return ""
    return "report.html" if (folder / one.job.name / "report.html").is_file() else "summary.json"


def _ranked(results: Sequence[JobResult]) -> list[tuple[JobResult, Sequence[str], str]]:
    rows = dict(zip((one.job.name for one in results), batch_table(results).rows, strict=True))
    return [(one, rows[one.job.name], one.error or one.remark) for one in outliers_first(results)]


def _cells(one: JobResult, columns: Sequence[str]) -> list[str]:
    figures = (one.figures.get(name) for name in columns)
    return [
        NOT_KNOWN if value is None else f"{value:.4g}" if isinstance(value, float) else str(value)
        for value in figures
    ]
