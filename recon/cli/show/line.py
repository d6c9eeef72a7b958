"""Progress in one line, which fits the terminal: what matters least is left out."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Final

from rich.console import Console, ConsoleOptions, RenderableType, RenderResult
from rich.progress import ProgressColumn, Task
from rich.progress_bar import ProgressBar
from rich.text import Text

_BAR: Final = range(5, 41)
"""Cells of a bar; where there is less room there is none."""
_NAME_SHARE: Final = 0.3
"""Share of the line that a name gets at least, where it is that long."""


class FittingColumn(ProgressColumn):
    """All that is shown of a task: its name, a bar, and then texts.

    Args:
        always: Texts that are always shown.
        if_room: Texts that follow where there is room, the most important one first.
    """

    def __init__(
        self, always: Sequence[ProgressColumn], if_room: Sequence[ProgressColumn] = ()
    ) -> None:
        super().__init__()
        self._always = always
        self._if_room = if_room

    def render(self, task: Task) -> RenderableType:
        """Return the line of a task."""
        bar = ProgressBar(
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
    bar: ProgressBar
    always: list[Text]
    if_room: list[Text]

    def __rich_console__(self, console: Console, options: ConsoleOptions) -> RenderResult:
        room = (
            options.max_width - 1
        )  # the last cell of a line stays free: some terminals wrap there
        name = min(self.name.cell_len, int(_NAME_SHARE * room))
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
    """Return what a column shows, which is text."""
    return shown if isinstance(shown, Text) else Text(str(shown))


def _width(texts: Sequence[Text]) -> int:
    """Return the cells of texts, each with a space before it."""
    return sum(1 + text.cell_len for text in texts)
