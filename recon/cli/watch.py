"""Shows a batch that runs elsewhere: a live table, or a line for each change."""

from __future__ import annotations

import sys
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import typer
from rich.console import Console
from rich.live import Live

from recon.cli.program import plan_jobs
from recon.cli.tables import batch_table
from recon.core.progress import stage
from recon.run.batch.job import is_done
from recon.run.batch.job_file import read_plan
from recon.run.batch.results import JobResult, watch_jobs, wrong_first


def show_batch(folder: Path) -> None:
    """Show how the jobs of a batch stand until it ends."""
    rounds = watch_jobs(folder, plan_jobs(read_plan(folder)))
    _refresh(rounds) if sys.stdout.isatty() else _list_changes(rounds)
    if not is_done(folder):
        hint = f"recon batch --resume {folder} does what is missing"
        typer.echo(f"warning: no process runs this batch; {hint}", err=True)


def _refresh(rounds: Iterator[list[JobResult]]) -> None:
    stage("")  # the table says it
    with Live(console=Console(), auto_refresh=False) as live:
        for results in rounds:
            rows = [one.summary for one in wrong_first(results)]
            live.update(batch_table(rows), refresh=True)


def _list_changes(rounds: Iterator[list[JobResult]]) -> None:
    """Write a line when the state or the try of a job changes."""
    shown: dict[str, tuple[Any, ...]] = {}
    for results in rounds:
        for one in results:
            now = one.facts.state, one.last.tries, one.progress
            if shown.get(one.job.name, ("not run", 0, "")) != now:
                why = f": {one.last.error if one.failed else one.progress}".removesuffix(": ")
                typer.echo(f"{one.job.name}: {now[0]}, try {now[1]}, {one.seconds:.1f} s{why}")
            shown[one.job.name] = now
