"""Prints results: a table for people, JSON for programs."""

from __future__ import annotations

import json
import re
from collections.abc import Mapping, Sequence
from typing import TYPE_CHECKING, Any, Final

import typer
from rich.console import Console
from rich.padding import Padding
from rich.table import Table
from rich.text import Text

from recon.core.text import counted, metres, visible, with_unit

if TYPE_CHECKING:
    from recon.commands.config import SettingGroup
    from recon.commands.doctor import Check

_MOST_JOBS: Final = 200  # more lines of a batch than these nobody reads


def print_json(content: Mapping[str, Any]) -> None:
    """Print the machine-readable summary, the only thing on standard output."""
    typer.echo(json.dumps(content, indent=2, allow_nan=False, ensure_ascii=False))


def print_figures(title: str, figures: Mapping[str, Any]) -> None:
    """Print a table of figures with their units; nested values appear only in ``--json``."""
    table = Table(show_header=False)
    for name, value in figures.items():
        if isinstance(value, str | bool):
            table.add_row(Text(visible(name)), Text(visible(str(value))))
        elif isinstance(value, int | float):
            text = f"{value:.4g}" if isinstance(value, float) else str(value)
            table.add_row(Text(visible(name)), with_unit(text, name))
    if title:
        typer.echo(visible(title))
    Console().print(table)


def print_evaluation(title: str, figures: Mapping[str, Any]) -> None:
    """Print the figures of a comparison and of each part, its warnings and its folder."""
    shown = {key: value for key, value in figures.items() if key != "out"}
    limits = figures.get("by_threshold", ())
    if len(limits) > 1:
        shown = {key: value for key, value in shown.items() if key not in limits[0]}
    for part in (*figures.get("by_length", ()), *(limits if len(limits) > 1 else ())):
        (_, name), *values = part.items()
        shown |= {f"{key} at {name:g} m": value for key, value in values}
    print_figures(title, shown)
    for warning in figures["warnings"]:
        typer.echo(visible(f"warning: {warning}"), err=True)
    if "out" in figures:
        typer.echo(f"results: {figures['out']}")


def print_run(summary: Mapping[str, Any], *, stages: bool = False) -> None:
    """Print a run's figures, its warnings and its folder."""
    shown = {key: value for key, value in summary.items() if key != "out"}
    for group in ("live", "prior", "loops", "links", "trajectory", "map", "disparity"):
        shown |= {f"{group}.{key}": value for key, value in summary.get(group, {}).items()}
    bad = summary.get("disparity", {}).get("bad", {})
    shown |= {f"disparity.bad {float(limit):g}": ratio for limit, ratio in bad.items()}
    latency_ms = summary.get("live", {}).get("latency_ms", {})
    shown |= {f"live.latency_ms.{key}": value for key, value in latency_ms.items()}
    for part in ("voxels", "grid"):
        figures = summary.get("occupancy", {}).get(part, {})
        shown |= {f"occupancy.{part}.{key}": value for key, value in figures.items()}
    for drive in summary.get("sessions", ()):
        place = "" if drive["linked"] else ", apart"
        shown[f"session {drive['number']}"] = (
            f"{drive['name']}: {counted(drive['frames'], 'frame')}{place}"
        )
    for name, point in summary.get("control", {}).items():
        off = ", ".join(metres(point[key], "+") for key in ("east_m", "north_m", "up_m"))
        kind = "check point" if point["check"] else "used" if point["used"] else "left out"
        shown[f"control {name}"] = f"{off} ± {metres(point['sigma_m'])}, {kind}"
    if stages:
        shown |= {f"seconds.{key}": value for key, value in summary["stages"].items()}
    print_figures("", shown)
    for warning in summary["warnings"]:
        typer.echo(visible(f"warning: {warning}"), err=True)
    typer.echo(f"results: {summary['out']}")


def print_batch(summary: Mapping[str, Any]) -> None:
    """Print a line per job, what is wrong first; then remarks, and why jobs failed."""
    from recon.run.batch.results import urgency

    jobs = sorted(summary["jobs"], key=lambda job: urgency(job, job["figures"]))
    Console().print(batch_table(jobs))
    if (more := len(jobs) - _MOST_JOBS) > 0:
        typer.echo(f"and {more} more, in table.csv")
    for job in jobs:
        if "remark" in job:
            typer.echo(visible(f"remark: {job['name']}: {job['remark']}"))
        if job["state"] == "failed":
            typer.echo(visible(f"error: {job['name']}: {job['error']}"), err=True)
    typer.echo(f"results: {summary['out']}")


def batch_table(all_jobs: Sequence[Mapping[str, Any]]) -> Table:
    """Return one line per job, with its size and the accuracy of its command."""
    from recon.run.batch.results import accuracies

    table, jobs = Table(show_edge=False, pad_edge=False), all_jobs[:_MOST_JOBS]
    judged = accuracies(job["figures"] for job in jobs)
    for title in ("job", "state", "tries", "s", "MB", *judged):
        table.add_column(re.sub(r"(?<=[a-z])[._]", " ", title), overflow="fold")
    for job in jobs:
        times = (str(job["tries"]), f"{job['seconds']:.1f}", f"{job['bytes'] / 1e6:.1f}")
        figures = (job["figures"].get(name) for name in judged)
        found = ("" if value is None else f"{value:.4g}" for value in figures)
        table.add_row(*map(Text, (job["name"], job["state"], *times, *found)))
    return table


def print_datasets(found: Mapping[str, Any]) -> None:
    """Print data sets or the parts of one: name, size, what is there, and what else is known."""
    table = Table(show_edge=False, pad_edge=False, show_header=False)
    for entry in found.get("datasets", found.get("parts", ())):
        size, fetched = entry.get("bytes"), entry.get("fetched")
        there = "fetched" if fetched else ""
        if not isinstance(fetched, bool):
            there = f"{fetched} of {entry.get('parts')}"
        about = (entry[key] for key in ("about", "licence") if key in entry)
        shown = f"{size / 1e9:.2f} GB" if size else ""
        table.add_row(entry["name"], shown, entry.get("out") or there, *about)
    Console().print(table)
    for key in ("page", "licence", "cite", "layout", "use", "unchecked"):
        if found.get(key):
            typer.echo(f"{key}: {found[key]}")


def print_checks(checks: Sequence[Check], console: Console | None = None) -> None:
    """Print one line per check, and below the table the hints for those that failed."""
    out = console or Console()
    table = Table(show_edge=False, pad_edge=False)
    for title in ("", "check", "found"):
        table.add_column(title, overflow="fold")
    for check in checks:
        table.add_row(_mark(check), Text(check.name), Text(check.found))
    out.print(table)
    failed = [check for check in checks if not check.ok]
    out.print()
    for check in failed:
        out.print(Text.assemble(_mark(check), " ", check.name, ": ", check.hint))
    if not any(check.needed for check in failed):
        out.print(Text("ready", style="bold green"))


def print_settings(groups: Sequence[SettingGroup], console: Console | None = None) -> None:
    """Print each setting in two lines: name, default and values; what it does."""
    out = console or Console(highlight=False)
    for group in groups:
        out.print(Text.assemble((group.name, "bold"), f"  {group.purpose}"))
        for entry in group.settings:
            default, values = f" = {entry.shown_default}", f"   [{entry.values}]"
            out.print(Text.assemble("  ", (entry.name, "cyan"), default, (values, "dim")))
            out.print(Padding(Text(entry.description, style="dim"), (0, 0, 0, 6)))
        out.print()


def _mark(check: Check) -> Text:
    if check.ok:
        return Text("ok", style="green")
    return Text("missing", style="bold red") if check.needed else Text("note", style="yellow")
