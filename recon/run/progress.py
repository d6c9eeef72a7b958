"""The progress of a run: what every command reports while it works, and what shows it."""

from __future__ import annotations

import threading
import time
from collections.abc import Iterator, Mapping
from contextlib import contextmanager
from typing import Any, Protocol, runtime_checkable


class Step(Protocol):
    """One item of a run that is done, such as a frame or a scene."""

    @property
    def seconds(self) -> float:
        """Time since the previous item was done."""

    @property
    def ok(self) -> bool:
        """Whether its result is to be trusted."""

    @property
    def event(self) -> Mapping[str, Any]:
        """Its figures for programs, ready for JSON; ``event`` names the kind of item."""

    @property
    def state(self) -> str:
        """Its result in a few words, for people; plain text."""


@runtime_checkable
class Progress(Protocol):
    """Receives the progress of a run, in its thread; what is not overridden does nothing."""

    def on_start(self, name: str, total: int, unit: str = "frames") -> None:
        """Begin a series of ``total`` items."""
        return

    def on_step(self, step: Step) -> None:
        """Count an item that is done."""
        return

    def on_stage(self, name: str) -> None:
        """Begin a stage that is not per item, such as ``mesh``."""
        return

    def on_finish(self) -> None:
        """End the series, successfully or not."""
        return


class Silent(Progress):
    """Shows no progress."""


SILENT = Silent()  # for runs that nobody watches


class Stopwatch:
    """Sums the wall-clock seconds of named stages; thread-safe."""

    def __init__(self) -> None:
        self._seconds: dict[str, float] = {}
        self._lock = threading.Lock()

    @contextmanager
    def stage(self, name: str) -> Iterator[None]:
        """Time the body of a ``with`` statement as part of stage ``name``."""
        start = time.perf_counter()
        try:
            yield
        finally:
            elapsed = time.perf_counter() - start
            with self._lock:
                self._seconds[name] = self._seconds.get(name, 0.0) + elapsed

    @property
    def seconds(self) -> dict[str, float]:
        """Seconds per stage, in the order in which the stages first ended."""
        with self._lock:
            return dict(self._seconds)
