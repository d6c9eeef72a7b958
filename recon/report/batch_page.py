"""The tables, the plot of a sweep and the report of a batch."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any, Final

import numpy as np
from matplotlib.axes import Axes

from recon.core.text import counted
from recon.io.atomic import write_bytes, write_text
from recon.report import style
from recon.report.page import write_page
from recon.report.sections import NOT_KNOWN, Image, Page, Section, Table, csv_text, join, known
from recon.run.batch.job import LOGS
from recon.run.batch.results import RUNS, JobResult, accuracies, wrong_first
from recon.run.directory import RunDirectory

#: Columns of the tables for people, where any job has them; the CSV has every figure.
_COLUMNS: Final = (
    "trajectory.t_rel_percent", "trajectory.ate_m", "map.f_score", "t_rel_percent", "f_score",
    "disparity.bad.2.0", "bad.2.0", "valid_percent", "frames", "path_length_m",
    "frames_not_trusted", "points", "peak_memory_mb", "expected_drift_percent", "map_mb_per_km",
    "changes.came", "changes.went", "warnings",
)  # fmt: skip
_OVER_TIME: Final = {
    "expected_drift_percent": "drift, %", "frames_not_trusted": "not trusted",
    "map_mb_per_km": "MB per km", "changes.came": "came", "changes.went": "went",
    "warnings": "warnings",
}  # fmt: skip
_PANEL_IN: Final = 3.2
_JOBS: Final = (
    "Failed ones first, then those with the largest fraction of frames that are not trusted, then "
    "with the largest drift. A remark says what is much worse than in other jobs of the same "
    "command and settings, or else what a job was warned of first. Links lead to the report of a "
    "run, where its command writes one, and of a failed job to its log."
)


def write_batch_page(
    results: Sequence[JobResult], summary: Mapping[str, Any], run: RunDirectory
) -> None:
    """Write the table as CSV, Markdown and LaTeX, and ``report.html``, what is wrong first."""
    write_text(run.path("table.csv"), batch_csv(results))
    tables = batch_tables(results)
    write_text(run.path("table.md"), join(table.markdown() for table in tables))
    write_text(run.path("table.tex"), join(table.latex() for table in tables))
    sweep, over_time = sweep_figure(results), time_figure(results)
    for name, png in (("sweep", sweep), ("time", over_time)):
        if png:
            write_bytes(run.path(f"{name}.png"), png)
    in_order = results[0].job.command == RUNS
    first = results if in_order else wrong_first(results)
    links = {one.job.name: _link(one, run.folder) for one in first}
    tables = [replace(table, links=links) for table in batch_tables(first)]
    warned = [(one.job.name, text) for one in first for text in one.warnings]
    what = "A point is a job, the line goes through the medians; other swept settings vary along."
    sections = [
        Section("Sweep", [Image("What each setting did", sweep, what)]),
        Section("Over time", [Image("What changed from run to run", over_time)]),
        Section("Jobs", tables, "" if in_order else _JOBS),
        Section("Warnings", [Table("By job", ("job", "warning"), warned)]),
    ]
    figures = [
        ("Jobs that succeeded", str(summary["succeeded"])),
        ("Jobs that failed", str(summary["failed"])),
        ("Storage, GB", f"{summary['bytes'] / 1e9:.3g}"),
        ("Jobs per hour", known("{:.0f}", summary["jobs_per_hour"])),
    ]
    failed = [f"{one.job.name}: {one.last.error}" for one in first if one.failed]
    many = counted(len({name for name, _ in warned}), "job")
    warnings = [*failed, *([f"warnings of {many} are below"] if warned else ())]
    title = f"Batch: {summary['succeeded']} of {len(summary['jobs'])} jobs"
    subtitle = f"{summary['failed']} failed, {summary['seconds']:.0f} s"
    write_page(Page(title, subtitle, figures, sections, summary, warnings), run)


def batch_tables(results: Sequence[JobResult]) -> list[Table]:
    """Return a table for people for each command: a row per job, with the figures of its kind."""
    return [_table(command, results) for command in dict.fromkeys(x.job.command for x in results)]


def _table(command: str, results: Sequence[JobResult]) -> Table:
    jobs = [one for one in results if one.job.command == command]
    columns = [name for name in _COLUMNS if any(name in one.figures for one in jobs)]
    rows, dated = [], any(one.date for one in jobs)
    for one in jobs:
        facts, figures = one.facts, (one.figures.get(name, NOT_KNOWN) for name in columns)
        cells = (f"{x:.4g}" if isinstance(x, float) else str(x) for x in figures)
        spent = (f"{one.seconds:.1f}", f"{one.bytes / 1e6:.1f}")
        shown = (facts.state, str(facts.tries), *spent)
        date = [one.date or NOT_KNOWN] if dated else []
        rows.append((one.job.name, *date, one.last.error or one.remark, *shown, *cells))
    head = ("job", *(["date"] if dated else ()), "remark", "state", "tries", "seconds", "MB")
    return Table(command, (*head, *columns), rows)


def batch_csv(results: Sequence[JobResult]) -> str:
    """Return the table for programs: every swept setting and every figure of every job."""
    swept = list(dict.fromkeys(key for one in results for key in one.job.swept))
    names = list(dict.fromkeys(key for one in results for key in one.figures))
    facts = (
        "name", "command", "source", "state", "tries", "seconds", "bytes", "error", "date",
    )  # fmt: skip
    rows = [
        [found.get(key, "") for found, keys in parts for key in keys]
        for parts in (
            ((one.facts.to_json(), facts), (one.job.swept, swept), (one.figures, names))
            for one in results
        )
    ]
    return csv_text([["job", *facts[1:], *swept, *names], *rows])


@style.styled
def time_figure(results: Sequence[JobResult]) -> bytes:
    """Draw drift, trust, storage, changes and warnings by date; empty of one."""
    dated = sorted((one for one in results if one.date and one.ok), key=lambda one: one.date)
    shown = {
        label: [one.figures.get(name, np.nan) for one in dated]
        for name, label in _OVER_TIME.items()
    }
    shown = {label: values for label, values in shown.items() if np.isfinite(values).any()}
    if len({one.date[:19] for one in dated}) < 2:
        return b""
    shown["MB"] = [one.bytes / 1e6 for one in dated]
    days = [np.datetime64(one.date[:19]) for one in dated]
    figure, panels = style.stacked(_PANEL_IN * len(shown) / 2, "", [*shown])
    for axes, values in zip(panels, shown.values(), strict=True):
        axes.plot(days, values, "o-", markersize=4)
        axes.set_ylim(0.0, 1.1 * np.nanmax(values) or 1.0)
    return style.to_png(figure)


@style.styled
def sweep_figure(results: Sequence[JobResult]) -> bytes:
    """Draw accuracy and time over each swept setting; empty if no job of a sweep succeeded."""
    done = [one for one in results if one.figures and one.job.swept]
    rows = list(dict.fromkeys((one.job.command, key) for one in done for key in one.job.swept))
    if not rows:
        return b""
    size_in = (style.WIDE_IN, _PANEL_IN * len(rows))
    figure, panels = style.subplots(*size_in, len(rows), 2, squeeze=False)
    for (command, setting), (left, right) in zip(rows, panels, strict=True):
        jobs = [one for one in done if one.job.command == command]
        for name in accuracies(one.figures for one in jobs)[:1]:
            _draw(left, jobs, setting, name)
        _draw(right, jobs, setting, "seconds")
    return style.to_png(figure)


def _draw(axes: Axes, jobs: Sequence[JobResult], setting: str, name: str) -> None:
    """Draw a figure of jobs of one command over a setting."""
    found: dict[str, list[float]] = {str(one.job.swept[setting]): [] for one in jobs}
    for one in jobs:
        if name in one.figures:
            found[str(one.job.swept[setting])].append(one.figures[name])
    for place, figures in enumerate(found.values()):
        axes.plot([place] * len(figures), figures, "o", color="C0", markersize=4, alpha=0.5)
    medians = [float(np.median(figures)) if figures else np.nan for figures in found.values()]
    axes.plot(range(len(found)), medians, "-", color="C1", label="median")
    axes.set_xticks(range(len(found)), [*map(style.label_of, found)])
    axes.set(xlabel=setting, ylabel=name, title=jobs[0].job.command)
    axes.legend()


def _link(one: JobResult, folder: Path) -> str:
    """Return what to look at of a job: its report, else its figures; its log if it failed."""
    if not one.ok:
        return f"{LOGS}/{one.job.name}.log" if one.failed else ""
    there = (folder / one.job.name / "report.html").is_file()
    return f"{one.job.name}/{'report.html' if there else 'summary.json'}"
