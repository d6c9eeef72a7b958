"""Shows the progress of a run: a bar for people, JSON lines for programs."""

from __future__ import annotations

import json
import logging
import math
import sys
import time
from collections.abc import Iterable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any, Final, TextIO

from rich.console import Console, ConsoleOptions, RenderableType, RenderResult
from rich.progress import (
    MofNCompleteColumn,
    Progress,
    ProgressColumn,
    Task,
    TextColumn,
    TimeElapsedColumn,
    TimeRemainingColumn,
)
from rich.progress_bar import ProgressBar as Bar
from rich.text import Text

from recon.core.progress import LOGGER, Silent, Step, showing
from recon.core.progress import Progress as Shown
from recon.core.text import counted, visible

if TYPE_CHECKING:
    from recon.sources.source import StereoSource

# Weight of the newest item in the displayed rate: steady enough to read, yet responsive.
_RATE_WEIGHT: Final = 0.2
_FIELDS: Final = ("rate", "state")
_STARTING: Final = "starting"  # while libraries are loaded
_WAITED_S: Final = 2.0  # a stage that takes longer leaves a line
_SLOW_S: Final = 10.0  # from which on an item has seconds, instead of a second items


def choose_viewer(
    *, quiet: bool = False, verbose: bool = False, stream: TextIO | None = None
) -> Shown:
    """Choose a progress bar on a terminal, elsewhere JSON lines if verbose, else nothing.

    ``stream`` None = standard error, as standard output is for results.
    """
    out = sys.stderr if stream is None else stream
    if quiet or not (out.isatty() or verbose):
        return Silent()
    return ProgressBar(Console(file=out)) if out.isatty() else JsonLines(out)


@contextmanager
def watched(*, quiet: bool = False, verbose: bool = False) -> Iterator[None]:
    """Show what a command does until the body ends, from its first moment on."""
    viewer = choose_viewer(quiet=quiet, verbose=verbose)
    notes = logging.NullHandler() if quiet else _Notes(viewer)
    LOGGER.addHandler(notes)
    try:
        with showing(viewer):
            if isinstance(viewer, ProgressBar):
                viewer.on_stage(_STARTING)
            yield
    finally:
        LOGGER.removeHandler(notes)
        if isinstance(viewer, ProgressBar):
            viewer.close()


class _Notes(logging.Handler):
    """Writes what the library logs as a warning: above the bar, as an event, or a line.

    What is ``passing`` is of no use to who reads it later, and is for terminals alone.
    """

    def __init__(self, viewer: Shown) -> None:
        super().__init__(logging.WARNING)
        self._viewer = viewer

    def emit(self, record: logging.LogRecord) -> None:
        if getattr(record, "passing", False) and not isinstance(self._viewer, ProgressBar):
            return
        if isinstance(self._viewer, JsonLines):
            self._viewer.on_note(record.getMessage())
        else:
            sys.stderr.write(f"{record.getMessage()}\n")


class JsonLines:
    """Writes one JSON object per event and line, and flushes it for who reads it at once."""

    def __init__(self, stream: TextIO) -> None:
        self._stream = stream

    def on_start(self, name: str, total: int, unit: str = "frames") -> None:
        self._write({"event": "start", "name": name, unit: total})

    def on_step(self, step: Step) -> None:
        self._write(step.event)

    def on_stage(self, name: str) -> None:
        self._write({"event": "stage", "name": name})

    def on_note(self, text: str) -> None:
        self._write({"event": "note", "text": text})

    def on_finish(self) -> None:
        self._write({"event": "finish"})

    def _write(self, event: Mapping[str, Any]) -> None:
        self._stream.write(json.dumps(event, allow_nan=False, ensure_ascii=False) + "\n")
        self._stream.flush()


class ProgressBar:
    """Shows one line: the items of a series, their rate and the last one, or a stage and its time.

    Who waited for one keeps a line of it. What begins within a series is the state of its line.
    """

    def __init__(self, console: Console) -> None:
        self._console = console
        self._progress: Progress | None = None
        self._depth, self._stage, self._since_s = 0, "", 0.0
        self._seconds = math.nan
        self._unit = ""
        self._bad = 0

    def on_start(self, name: str, total: int, unit: str = "frames") -> None:
        self._depth += 1
        if self._depth > 1:
            self._update(state=name)
            return
        self.close()
        self._seconds, self._unit, self._bad = math.nan, unit, 0
        bad = TextColumn("{task.fields[bad]}", style="bold red")
        rate, state = (TextColumn(f"{{task.fields[{one}]}}", markup=False) for one in _FIELDS)
        column = FittingColumn([MofNCompleteColumn(), bad], [rate, TimeRemainingColumn(), state])
        self._show(name, column, total=total or None)

    def on_step(self, step: Step) -> None:
        if self._depth == 1:
            self._bad += not step.ok
            word = "failed" if self._unit in ("jobs", "pieces") else "not trusted"
            bad = f"{self._bad} {word}" if self._bad else ""
            self._update(advance=1, rate=self._rate(step), state=step.state, bad=bad)

    def on_stage(self, name: str) -> None:
        if self._depth:
            self._update(state=name)
            return
        self.close()
        self._stage = name
        if name:
            self._show(name, FittingColumn([TimeElapsedColumn()]), total=None)

    def on_finish(self) -> None:
        self._depth = max(0, self._depth - 1)
        if self._depth == 0:
            self._stop(leave=self._waited_s > _WAITED_S)
            self.on_stage(self._stage)  # what the series was part of goes on

    def close(self) -> None:
        """End the stage that is shown, if any."""
        shown, waited_s = self._progress is not None, self._waited_s
        self._stop(leave=False)
        if shown and waited_s > _WAITED_S and self._stage != _STARTING:
            line = f"{self._stage}: {waited_s:.0f} s"
            self._console.print(line, style="dim", markup=False, highlight=False)

    def _show(self, name: str, column: FittingColumn, *, total: int | None) -> None:
        self._since_s = time.monotonic()
        self._progress = Progress(column, console=self._console, refresh_per_second=4)
        self._progress.add_task(visible(name), total=total, rate="", state="", bad="")
        self._progress.start()

    def _update(self, *, state: str = "", **fields: Any) -> None:
        if self._progress is not None:
            self._progress.update(self._progress.task_ids[0], state=visible(state), **fields)

    @property
    def _waited_s(self) -> float:
        return time.monotonic() - self._since_s

    def _stop(self, *, leave: bool) -> None:
        if self._progress is not None:
            self._progress.live.transient = not leave
            self._progress.stop()
            self._progress = None

    def _rate(self, step: Step) -> str:
        if math.isnan(self._seconds):
            self._seconds = step.seconds
        self._seconds += _RATE_WEIGHT * (step.seconds - self._seconds)
        if self._seconds >= _SLOW_S:
            return f"{self._seconds:.0f} s each"
        return f"{1.0 / self._seconds:.1f} {self._unit}/s" if self._seconds > 0 else ""


_BAR: Final = range(5, 41)  # cells of a bar; where there is less room there is none
_NAME_RATIO: Final = 0.3  # fraction of the line that a name gets at least, where it is that long


class FittingColumn(ProgressColumn):
    """All that is shown of a task: its name, a bar, and texts; those ``if_room`` by importance."""

    def __init__(
        self, always: Sequence[ProgressColumn], if_room: Sequence[ProgressColumn] = ()
    ) -> None:
        super().__init__()
        self._always = always
        self._if_room = if_room

    def render(self, task: Task) -> RenderableType:
        bar = Bar(
            total=task.total,
            completed=task.completed,
            pulse=not task.started or task.total is None,
            animation_time=task.get_time(),
        )
        always, if_room = (
            [text for column in columns if (text := _text(column(task)))]
            for columns in (self._always, self._if_room)
        )
        return _Line(Text(task.description), bar, always, if_room)


@dataclass
class _Line:
    """A line, which is laid out when its width is known."""

    name: Text
    bar: Bar
    always: list[Text]
    if_room: list[Text]

    def __rich_console__(self, console: Console, options: ConsoleOptions) -> RenderResult:
        room = options.max_width - 1  # some terminals wrap in the last cell
        name = min(self.name.cell_len, int(_NAME_RATIO * room))
        shown = list(self.always)
        for text in self.if_room:
            if name + _width([*shown, text]) > room:
                break
            shown.append(text)
        self.name.truncate(max(name, room - _width(shown)), overflow="ellipsis")
        yield from self._joined(room, shown)

    def _joined(self, room: int, shown: Sequence[Text]) -> RenderResult:
        self.bar.width = min(room - self.name.cell_len - _width(shown) - 1, _BAR[-1])
        # The column would fill up each part to its own width, were it not for the justification.
        bar = self.bar.width >= _BAR[0]
        yield Text.assemble(self.name, " " if bar else "", justify="default", end="")
        if bar:
            yield self.bar
        yield Text.assemble(*(part for text in shown for part in (" ", text)), justify="default")


def _text(shown: RenderableType) -> Text:
    return shown if isinstance(shown, Text) else Text(str(shown))


def _width(texts: Sequence[Text]) -> int:
    """Return the cells of texts, each with a space before it."""
    return sum(1 + text.cell_len for text in texts)


def announce(source: StereoSource, **how: Any) -> None:
    """Write one line about a source: text on a terminal, else a JSON object if ``verbose``.

    Nothing if ``quiet``; into ``stream``, None = standard error.
    """
    about = {"name": source.name, "description": source.description, "frames": len(source)}
    many = f", {counted(len(source), 'pair')}" if len(source) else ""
    _write(f"{source.name}: {source.description}{many}", {"event": "source", **about}, **how)


def warn(lines: Iterable[str], **how: Any) -> None:
    """Write warnings before the run starts, each in the form of `announce`."""
    for line in lines:
        _write(f"warning: {line}", {"event": "warning", "text": line}, **how)


def _write(
    text: str,
    event: dict[str, object],
    *,
    quiet: bool = False,
    verbose: bool = False,
    stream: TextIO | None = None,
) -> None:
    out = sys.stderr if stream is None else stream
    if not quiet and (out.isatty() or verbose):
        out.write((visible(text) if out.isatty() else json.dumps(event, ensure_ascii=False)) + "\n")
        out.flush()
