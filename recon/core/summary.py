"""What a command found, as values, and how they become JSON.

A summary is a frozen dataclass: each field is a figure, named with its unit, and a key of
``summary.json``. Reports, the terminal and ``--json`` are views of it.
"""

from __future__ import annotations

import math
import shlex
from abc import ABC, abstractmethod
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import MISSING, dataclass, field, fields, is_dataclass
from importlib.util import find_spec
from pathlib import Path
from typing import Any, Final

import numpy as np

_FORM: Final = "json"  # key of the metadata of a field
_LEFT_OUT, _HIDDEN, _INLINE, _INLINE_EACH = "left out", "hidden", "inline", "inline each"
Rows = list[tuple[str, ...]]
"""What a command says when it is done: a sentence, or a subject, a file or folder, and figures."""


class Figures:
    """Base of summaries and their parts, which are frozen dataclasses."""

    def to_json(self) -> dict[str, Any]:
        """Return the figures by key, as JSON has them."""
        return dict(to_json(self))


def optional(key: str = "") -> Any:
    """Return a field whose key is left out of the JSON where it is None, which is its default.

    The ``key`` is another one than the name of the field, if it is given.
    """
    return field(default=None, metadata={_FORM: _LEFT_OUT, **({"key": key} if key else {})})


def inline(default: Any = MISSING) -> Any:
    """Return a field with a part, if there is one, whose keys are among those of the whole."""
    return field(default=default, metadata={_FORM: _INLINE})


def inline_each() -> Any:
    """Return a field with parts by name, whose keys are among those of the whole."""
    return field(default_factory=dict, metadata={_FORM: _INLINE_EACH})


def hidden(default: Any = MISSING) -> Any:
    """Return a field for the terminal alone, which is not in the JSON."""
    return field(default=default, metadata={_FORM: _HIDDEN})


def named(key: str) -> Any:
    """Return a field whose key in JSON cannot be a name in Python."""
    return field(metadata={_FORM: _LEFT_OUT, "key": key})


class Summary(Figures, ABC):
    """What a command found, as a whole."""

    @abstractmethod
    def rows(self) -> Rows:
        """Return what the terminal says, at most eight lines."""

    def remarks(self) -> list[tuple[str, str]]:
        """Return kind and text of what the user should know, which stands apart."""
        return []


@dataclass(frozen=True, kw_only=True)
class RunSummary(Summary):
    """What every command has: warnings, what it cost, and where its results are.

    The cost is known at the end, and only of a run that has a folder.
    """

    warnings: Sequence[str] = ()  # what the user should know, the most important first
    seconds: float | None = optional()  # wall-clock time
    stages: Mapping[str, float] | None = optional()  # seconds by stage; stages may overlap
    peak_memory_mb: float | None = optional()
    out: str | None = optional()  # the result folder

    def remarks(self) -> list[tuple[str, str]]:
        return [("warning", text) for text in self.warnings]

    def rows(self) -> Rows:
        return [*self.folder_row(), *self.cost_row()]

    def cost_row(self, *more: str) -> Rows:
        """Return the line of what the run cost; none where that is not known."""
        if self.seconds is None:
            return []
        memory = f"{(self.peak_memory_mb or 0.0) / 1e3:.2g} GB of memory"
        return [("cost", ", ".join((f"{self.seconds:.1f} s", *more, memory)))]

    def open_report(self) -> str:
        """Return the command that opens the report."""
        return f"xdg-open {shown_path(self.out or '', 'report.html')}"

    def open_view(self) -> str:
        """Return the command that shows the result: the report, where the extra view is missing."""
        if find_spec("viser") is None:
            return self.open_report()
        return f"recon view {shown_path(self.out or '')}"

    def folder_row(self) -> Rows:
        """Return the line of the result folder, if there is one."""
        return [] if self.out is None else [("folder", self.out)]


def shown_path(*parts: str) -> str:
    """Return a path as a command takes it that a user pastes."""
    return shlex.quote(str(Path(*parts)))


def to_json(value: Any) -> Any:
    """Convert a value for JSON: dataclasses to mappings, arrays to lists, NaN, infinity to None."""
    if is_dataclass(value) and not isinstance(value, type):
        return dict(_items(value))
    if isinstance(value, Mapping):
        return {str(key): to_json(item) for key, item in value.items()}
    if isinstance(value, np.ndarray):
        return to_json(value.tolist())
    if isinstance(value, list | tuple):
        return [to_json(item) for item in value]
    if isinstance(value, float):
        return value if math.isfinite(value) else None
    return value


def _items(value: Any) -> Iterator[tuple[str, Any]]:
    """Yield keys and values of the fields of a dataclass."""
    for one in fields(value):
        part, form = getattr(value, one.name), one.metadata.get(_FORM)
        if form in (_INLINE, _INLINE_EACH):
            parts = part.values() if form == _INLINE_EACH else () if part is None else (part,)
            for each in parts:
                yield from to_json(each).items()
        elif form != _HIDDEN and (form != _LEFT_OUT or part is not None):
            yield one.metadata.get("key", one.name), to_json(part)
