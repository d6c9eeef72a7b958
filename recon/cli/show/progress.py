"""Shows the progress of a run: a bar for people, JSON lines for programs."""

from __future__ import annotations

import json
import math
import sys
from collections.abc import Mapping
from typing import Any, Final, TextIO

from rich.console import Console
from rich.progress import MofNCompleteColumn, Progress, TextColumn, TimeRemainingColumn

from recon.cli.show.line import FittingColumn
from recon.run.progress import Progress as Shown
from recon.run.progress import Silent, Step

# Weight of the newest item in the displayed rate: steady enough to read, yet responsive.
_RATE_WEIGHT: Final = 0.2
_SLOW_S: Final = 10.0
"""From which on an item has seconds, instead of a second items."""


def choose_viewer(
    *, quiet: bool = False, verbose: bool = False, stream: TextIO | None = None
) -> Shown:
    """Choose a progress bar on a terminal, elsewhere JSON lines if verbose, else nothing.

    Args:
        quiet: Whether to show no progress.
        verbose: Whether to write JSON lines where the stream is no terminal.
        stream: Output stream; None = standard error, as standard output is for results.
    """
    out = sys.stderr if stream is None else stream
    if quiet or not (out.isatty() or verbose):
        return Silent()
    return ProgressBar(Console(file=out)) if out.isatty() else JsonLines(out)


class JsonLines:
    """Writes one JSON object per event and line.

    Args:
        stream: Output stream; flushed after each line, so that a reader sees it at once.
    """

    def __init__(self, stream: TextIO) -> None:
        self._stream = stream

    def on_start(self, name: str, total: int, unit: str = "frames") -> None:
        """Write the name of the source and its number of items."""
        self._write({"event": "start", "name": name, unit: total})

    def on_step(self, step: Step) -> None:
        """Write the figures of an item."""
        self._write(step.event)

    def on_stage(self, name: str) -> None:
        """Write the name of the stage that starts."""
        self._write({"event": "stage", "name": name})

    def on_finish(self) -> None:
        """Write that all items are done."""
        self._write({"event": "finish"})

    def _write(self, event: Mapping[str, Any]) -> None:
        self._stream.write(json.dumps(event, allow_nan=False, ensure_ascii=False) + "\n")
        self._stream.flush()


class ProgressBar:
    """Shows a bar with the number of items, their rate, and the state of the last one."""

    def __init__(self, console: Console) -> None:
        self._console = console
        self._progress: Progress | None = None
        self._seconds = math.nan
        self._unit = ""
        self._bad = 0

    def on_start(self, name: str, total: int, unit: str = "frames") -> None:
        """Draw an empty bar."""
        self.on_finish()
        self._seconds, self._unit, self._bad = math.nan, unit, 0
        self._progress = Progress(
            FittingColumn(
                [MofNCompleteColumn(), TextColumn("{task.fields[bad]}", style="bold red")],
                [
                    TextColumn("{task.fields[rate]}"),
                    TimeRemainingColumn(),
                    TextColumn("{task.fields[state]}", markup=False),
                ],
            ),
            console=self._console,
        )
        self._progress.add_task(name, total=total or None, rate="", state="", bad="")
        self._progress.start()

    def on_step(self, step: Step) -> None:
        """Move the bar by one item."""
        if self._progress is None:
            return
        self._bad += not step.ok
        word = "failed" if self._unit in ("jobs", "pieces") else "not trusted"
        bad = f"{self._bad} {word}" if self._bad else ""
        task = self._progress.task_ids[0]
        self._progress.update(task, advance=1, rate=self._rate(step), state=step.state, bad=bad)

    def on_stage(self, name: str) -> None:
        """Print the name of the stage that starts."""
        self._console.print(f"{name} …", style="dim", markup=False, highlight=False)

    def on_finish(self) -> None:
        """Leave the bar as it is."""
        if self._progress is not None:
            self._progress.stop()
            self._progress = None

    def _rate(self, step: Step) -> str:
        if math.isnan(self._seconds):
            self._seconds = step.seconds
        self._seconds += _RATE_WEIGHT * (step.seconds - self._seconds)
        if self._seconds >= _SLOW_S:
            return f"{self._seconds:.0f} s each"
        return f"{1.0 / self._seconds:.1f} {self._unit}/s" if self._seconds > 0 else ""
