"""Prints results: a few lines or all figures for people, JSON for programs."""

from __future__ import annotations

import json
import re
from collections.abc import Iterable, Iterator, Mapping, Sequence
from typing import TYPE_CHECKING, Any, Final

import typer
from rich.console import Console
from rich.padding import Padding
from rich.table import Table
from rich.text import Text

from recon.core.text import visible, with_unit

if TYPE_CHECKING:
    from recon.commands.batch import BatchSummary
    from recon.commands.config import SettingGroup
    from recon.commands.doctor import Check
    from recon.core.summary import Rows, Summary
    from recon.run.batch.results import JobSummary

_NUMBER: Final = re.compile(r"\d[\d.,]*")
_MOST_JOBS: Final = 200  # more lines of a batch than these nobody reads


def print_json(content: Mapping[str, Any]) -> None:
    """Print the machine-readable summary, the only thing on standard output."""
    typer.echo(json.dumps(content, indent=2, allow_nan=False, ensure_ascii=False))


def print_summary(summary: Summary, *, as_json: bool = False, verbose: bool = False) -> None:
    """Print what a command found, in a few lines, and warnings apart; ``verbose``: all figures."""
    if as_json:
        print_json(summary.to_json())
        return
    print_remarks(summary.remarks(), verbose=verbose)
    if verbose:
        print_figures(summary.to_json())
    print_rows(summary.rows())


def print_rows(rows: Rows) -> None:
    """Print a sentence and aligned lines: what they are about, a file, figures."""
    longest = [max((len(row[at]) for row in rows if len(row) > at + 1), default=0) for at in (0, 1)]
    for row in rows:
        cells = (text.ljust(longest[at]) for at, text in enumerate(row[:-1]))
        typer.echo(visible("  ".join((*cells, row[-1]))))


def print_remarks(remarks: Iterable[tuple[str, str]], *, verbose: bool = False) -> None:
    """Print what the user should know on standard error, a line each.

    Those that differ in numbers alone are counted, unless ``verbose``.
    """
    kinds: dict[str, list[str]] = {}
    for number, (kind, text) in enumerate(remarks):
        line = f"{kind}: {text}"
        kinds.setdefault(str(number) if verbose else _NUMBER.sub("#", line), []).append(line)
    for first, *others in kinds.values():
        more = f" (and {len(others)} more like it)" if others else ""
        typer.echo(visible(first + more), err=True)


def print_figures(figures: Mapping[str, Any]) -> None:
    """Print a table of all figures with their units, those of parts by dotted name."""
    table = Table(show_header=False)
    for name, value in _leaves(figures):
        if isinstance(value, str | bool):
            table.add_row(Text(visible(name)), Text(visible(str(value))))
        else:
            text = f"{value:.4g}" if isinstance(value, float) else str(value)
            table.add_row(Text(visible(name)), with_unit(text, name))
    Console().print(table)


def _leaves(figures: Mapping[str, Any], prefix: str = "") -> Iterator[tuple[str, Any]]:
    """Yield names and values; lists have parts alone, since others are rows of a matrix."""
    for key, value in figures.items():
        if isinstance(value, Mapping):
            yield from _leaves(value, f"{prefix}{key}.")
        elif isinstance(value, str | bool | int | float):
            yield f"{prefix}{key}", value
        elif isinstance(value, Sequence):
            parts = {str(at): part for at, part in enumerate(value) if isinstance(part, Mapping)}
            yield from _leaves(parts, f"{prefix}{key}.")


def print_batch(summary: BatchSummary, *, as_json: bool = False, verbose: bool = False) -> None:
    """Print how a batch ended; ``verbose``: a line per job, what is wrong first."""
    from recon.run.batch.results import urgency

    jobs = sorted(summary.jobs, key=lambda job: urgency(job.facts, job.figures))
    if not as_json:
        failed = [job.facts for job in jobs if job.facts.error is not None]
        print_remarks((("error", f"{job.name}: {job.error}") for job in failed), verbose=verbose)
    if verbose and not as_json:
        Console().print(batch_table(jobs))
        if (more := len(jobs) - _MOST_JOBS) > 0:
            typer.echo(f"and {more} more, in table.csv")
        for job in jobs:
            if job.facts.remark is not None:
                typer.echo(visible(f"remark: {job.facts.name}: {job.facts.remark}"))
    print_summary(summary, as_json=as_json)


def batch_table(all_jobs: Sequence[JobSummary]) -> Table:
    """Return one line per job, with its size and the accuracy of its command."""
    from recon.run.batch.results import accuracies

    table, jobs = Table(show_edge=False, pad_edge=False), all_jobs[:_MOST_JOBS]
    warned = ["warnings"] if any(job.warnings for job in jobs) else []
    judged = accuracies(job.figures for job in jobs)
    for title in ("job", "state", "tries", "s", "MB", *judged, *warned):
        table.add_column(re.sub(r"(?<=[a-z])[._]", " ", title), overflow="fold")
    for job in jobs:
        facts = job.facts
        times = (str(facts.tries), f"{facts.seconds:.1f}", f"{facts.bytes / 1e6:.1f}")
        state = ": ".join(filter(None, (facts.state, facts.progress)))
        figures = (job.figures.get(name) for name in judged)
        found = ("" if value is None else f"{value:.4g}" for value in figures)
        many = [str(len(job.warnings)) for _ in warned]
        table.add_row(*map(Text, (facts.name, state, *times, *found, *many)))
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
