"""Shows the jobs of a batch: one line for each that runs, or JSON lines for programs."""

from __future__ import annotations

import sys
from collections.abc import Mapping
from typing import Any, TextIO

from rich.console import Console
from rich.progress import BarColumn, MofNCompleteColumn, Progress, TextColumn, TimeElapsedColumn

from recon.cli.show.progress import JsonLines
from recon.run.progress import Silent, Step


def choose_job_viewer(
    *, quiet: bool = False, verbose: bool = False, stream: TextIO | None = None
) -> JobLines | JobEvents | NoJobs:
    """Choose lines on a terminal, elsewhere JSON lines if verbose, else nothing.

    Args:
        quiet: Whether to show no progress.
        verbose: Whether to write JSON lines where the stream is no terminal.
        stream: Output stream; None = standard error, as standard output is for results.
    """
    out = sys.stderr if stream is None else stream
    if quiet or not (out.isatty() or verbose):
        return NoJobs()
    return JobLines(Console(file=out)) if out.isatty() else JobEvents(out)


class NoJobs(Silent):
    """Shows nothing."""

    def on_job(self, event: Mapping[str, Any]) -> None:
        """Ignore it."""


class JobEvents(JsonLines):
    """Writes one JSON object per event and line."""

    def on_job(self, event: Mapping[str, Any]) -> None:
        """Write an event of the cluster or of a running job."""
        self._write(event)


class JobLines:
    """Shows a bar for the batch, and below it a line for each job that runs.

    Args:
        console: The console to draw on.
    """

    def __init__(self, console: Console) -> None:
        self._console = console
        self._lines = Progress(
            TextColumn("{task.description}", markup=False),
            BarColumn(bar_width=None),
            MofNCompleteColumn(),
            TimeElapsedColumn(),
            TextColumn("{task.fields[state]}", markup=False),
            console=console,
        )
        self._running: dict[str, Any] = {}
        self._ended = set[str]()
        self._failed = 0

    def on_start(self, name: str, total: int, unit: str = "jobs") -> None:
        """Draw an empty bar."""
        del unit
        self._running[""] = self._lines.add_task(name, total=total, state="")
        self._lines.start()

    def on_job(self, event: Mapping[str, Any]) -> None:
        """Print where the cluster shows itself, or draw the line of a running job."""
        if event["event"] == "cluster":
            text = f"{event['workers']} workers, dashboard: {event['dashboard']}"
            self._console.print(text, markup=False, highlight=False)
            return
        name = event["name"]
        if name in self._ended:  # told before it ended, heard after
            return
        if name not in self._running:
            self._running[name] = self._lines.add_task(name, total=None, state="")
        self._lines.update(
            self._running[name],
            completed=event.get("frames"),
            total=event.get("of"),
            state=event.get("stage", ""),
        )

    def on_step(self, step: Step) -> None:
        """Remove the line of a job that has ended, and move the bar."""
        name, _, why = step.state.partition(" ")
        self._ended.add(name)
        if name in self._running:
            self._lines.remove_task(self._running.pop(name))
        if not step.ok:
            self._failed += 1
            self._console.print(f"{name}: {why}", style="red", markup=False, highlight=False)
        failed = f"{self._failed} failed" if self._failed else ""
        self._lines.update(self._running[""], advance=1, state=failed)

    def on_stage(self, name: str) -> None:
        """Print the name of the stage that starts."""
        self._console.print(f"{name} …", style="dim", markup=False, highlight=False)

    def on_finish(self) -> None:
        """Leave the bar as it is."""
        self._lines.stop()
