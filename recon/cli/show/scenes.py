"""Observers that show the progress of an evaluation: a bar for people, lines for programs."""

from __future__ import annotations

import json
import sys
from collections.abc import Mapping
from typing import Any, TextIO

from rich.console import Console
from rich.progress import BarColumn, MofNCompleteColumn, Progress, TextColumn, TimeElapsedColumn

from recon.commands.evaluate_middlebury import SceneObserver


def choose_scene_viewer(
    *, quiet: bool = False, verbose: bool = False, stream: TextIO | None = None
) -> SceneObserver:
    """Choose a progress bar on a terminal, elsewhere JSON lines if verbose, else nothing.

    Args:
        quiet: Whether to show no progress.
        verbose: Whether to write JSON lines where the stream is no terminal.
        stream: Output stream; None = standard error, as standard output is for results.
    """
    out = sys.stderr if stream is None else stream
    if quiet or not (out.isatty() or verbose):
        return QuietScenes()
    return SceneBar(Console(file=out)) if out.isatty() else SceneLines(out)


class QuietScenes:
    """Shows nothing."""

    def on_start(self, name: str, total: int) -> None:
        """Ignore it."""

    def on_scene(self, name: str, figures: Mapping[str, Any]) -> None:
        """Ignore it."""

    def on_finish(self) -> None:
        """Ignore it."""


class SceneLines:
    """Writes one JSON object per event and line.

    Args:
        stream: Output stream; flushed after each line, so that a reader sees it at once.
    """

    def __init__(self, stream: TextIO) -> None:
        self._stream = stream

    def on_start(self, name: str, total: int) -> None:
        """Write the folder and its number of scenes."""
        self._write({"event": "start", "name": name, "scenes": total})

    def on_scene(self, name: str, figures: Mapping[str, Any]) -> None:
        """Write the seconds of each matcher; empty if the scene has no ground truth."""
        seconds = {matcher: one["seconds"] for matcher, one in figures.items()}
        self._write({"event": "scene", "name": name, "seconds": seconds})

    def on_finish(self) -> None:
        """Write that all scenes are done."""
        self._write({"event": "finish"})

    def _write(self, event: Mapping[str, Any]) -> None:
        self._stream.write(json.dumps(event, allow_nan=False, ensure_ascii=False) + "\n")
        self._stream.flush()


class SceneBar:
    """Shows a bar with the last finished scene.

    Args:
        console: The console to draw on.
    """

    def __init__(self, console: Console) -> None:
        self._progress = Progress(
            TextColumn("{task.description}", markup=False),
            BarColumn(bar_width=None),
            MofNCompleteColumn(),
            TimeElapsedColumn(),
            TextColumn("{task.fields[last]}", markup=False),
            console=console,
        )

    def on_start(self, name: str, total: int) -> None:
        """Draw an empty bar."""
        self._progress.add_task(name, total=total, last="")
        self._progress.start()

    def on_scene(self, name: str, figures: Mapping[str, Any]) -> None:
        """Move the bar by one scene."""
        last = name if figures else f"{name}: no truth"
        self._progress.update(self._progress.task_ids[-1], advance=1, last=last)

    def on_finish(self) -> None:
        """Leave the bar as it is."""
        self._progress.stop()
