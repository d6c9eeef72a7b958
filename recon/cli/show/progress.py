"""Observers that show the progress of a run: a bar for people, JSON lines for programs."""

from __future__ import annotations

import json
import math
import sys
from typing import Any, Final, TextIO

from rich.console import Console
from rich.progress import BarColumn, MofNCompleteColumn, Progress, TextColumn, TimeRemainingColumn

from recon.map.observer import FrameResult, Observer

# Weight of the newest frame in the displayed rate: steady enough to read, yet responsive.
_RATE_WEIGHT: Final = 0.2


def choose_viewer(
    *, quiet: bool = False, verbose: bool = False, stream: TextIO | None = None
) -> Observer:
    """Choose a progress bar on a terminal, elsewhere JSON lines if verbose, else nothing.

    Args:
        quiet: Whether to show no progress.
        verbose: Whether to write JSON lines where the stream is no terminal.
        stream: Output stream; None = standard error, as standard output is for results.
    """
    out = sys.stderr if stream is None else stream
    if quiet or not (out.isatty() or verbose):
        return Quiet()
    return RichProgress(Console(file=out)) if out.isatty() else JsonLines(out)


class Quiet:
    """Shows nothing."""

    def on_start(self, name: str, total: int) -> None:
        """Ignore it."""

    def on_frame(self, result: FrameResult) -> None:
        """Ignore it."""

    def on_stage(self, name: str) -> None:
        """Ignore it."""

    def on_finish(self) -> None:
        """Ignore it."""


class JsonLines:
    """Writes one JSON object per event and line; NaN becomes null.

    Args:
        stream: Output stream; flushed after each line, so that a reader sees it at once.
    """

    def __init__(self, stream: TextIO) -> None:
        self._stream = stream

    def on_start(self, name: str, total: int) -> None:
        """Write the name of the source and its number of frames."""
        self._write({"event": "start", "name": name, "frames": total})

    def on_frame(self, result: FrameResult) -> None:
        """Write the result of a frame."""
        health = result.health
        self._write(
            {
                "event": "frame",
                "index": result.index,
                "total": result.total,
                "seconds": round(result.seconds, 4),
                "valid_share": _finite(result.valid_share),
                "points": result.points,
                "position_m": [_finite(x) for x in result.T_world_camera[:3, 3].tolist()],
                "measured": health.ok,
                "inliers": health.inliers,
                "overlap": _finite(health.overlap),
                "notes": list(health.notes),
            }
        )

    def on_stage(self, name: str) -> None:
        """Write the name of the stage that starts."""
        self._write({"event": "stage", "name": name})

    def on_finish(self) -> None:
        """Write that all frames are done."""
        self._write({"event": "finish"})

    def _write(self, event: dict[str, Any]) -> None:
        self._stream.write(json.dumps(event, allow_nan=False, ensure_ascii=False) + "\n")
        self._stream.flush()


class RichProgress:
    """Shows a bar with frames, rate, valid pixels and whether the pose is trusted.

    Args:
        console: The console to draw on.
    """

    def __init__(self, console: Console) -> None:
        self._console = console
        self._progress: Progress | None = None
        self._seconds = math.nan
        self._lost = 0

    def on_start(self, name: str, total: int) -> None:
        """Draw an empty bar."""
        self.on_finish()
        self._seconds, self._lost = math.nan, 0
        self._progress = Progress(
            TextColumn("{task.description}", markup=False),
            BarColumn(bar_width=None),
            MofNCompleteColumn(),
            TextColumn("{task.fields[rate]}"),
            TimeRemainingColumn(),
            TextColumn("{task.fields[state]}", markup=True),
            console=self._console,
        )
        self._progress.add_task(name, total=total, rate="", state="")
        self._progress.start()

    def on_frame(self, result: FrameResult) -> None:
        """Move the bar by one frame."""
        if self._progress is None:
            return
        self._lost += not result.health.ok
        task = self._progress.task_ids[0]
        self._progress.update(task, advance=1, rate=self._rate(result), state=self._state(result))

    def on_stage(self, name: str) -> None:
        """Print the name of the stage that starts."""
        self._console.print(f"{name} …", style="dim", markup=False, highlight=False)

    def on_finish(self) -> None:
        """Leave the bar as it is."""
        if self._progress is not None:
            self._progress.stop()
            self._progress = None

    def _rate(self, result: FrameResult) -> str:
        if math.isnan(self._seconds):
            self._seconds = result.seconds
        self._seconds += _RATE_WEIGHT * (result.seconds - self._seconds)
        return f"{1.0 / self._seconds:.1f} fps" if self._seconds > 0 else ""

    def _state(self, result: FrameResult) -> str:
        valid = f"{100 * result.valid_share:.0f} % valid"
        if not result.health.ok:
            return f"{valid} [bold red]pose not trusted[/]"
        lost = f" [yellow]({self._lost} not trusted)[/]" if self._lost else ""
        return f"{valid} [green]tracking, {result.health.inliers} inliers[/]{lost}"


def _finite(value: float) -> float | None:
    return round(value, 6) if math.isfinite(value) else None
