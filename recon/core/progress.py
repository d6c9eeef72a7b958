"""What a run is doing, as whoever watches is told: a bar, JSON lines, a log.

Work deep below a command says so by `stage` and `tracked`; nothing is handed down to it. Who is
told is chosen once, around the work, by `showing`; else it is the logger ``recon``: stages and, now
and then, a count (INFO), and that kernels are being compiled (WARNING).
"""

from __future__ import annotations

import logging
import threading
import time
from collections.abc import Iterable, Iterator, Mapping, Sized
from contextlib import contextmanager
from contextvars import ContextVar
from dataclasses import dataclass
from typing import Any, Final, Protocol, TypeVar, runtime_checkable

LOGGER: Final = logging.getLogger("recon")
_COUNT_EVERY_S: Final = 1.0

Item = TypeVar("Item")


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
        """Begin a series of ``total`` items; 0 = nobody knows how many."""
        return

    def on_step(self, step: Step) -> None:
        return

    def on_stage(self, name: str) -> None:
        """Begin a stage that is not per item, such as ``mesh``; it lasts until the next one."""
        return

    def on_finish(self) -> None:
        """End the series, successfully or not."""
        return


class Silent(Progress):
    """Shows no progress."""


class _Logged(threading.local):
    """Logs the progress of each thread: stages, and every second how far a series is."""

    _name, _unit, _total, _done, _said_s = "", "", 0, 0, 0.0

    def on_start(self, name: str, total: int, unit: str = "frames") -> None:
        self._name, self._unit, self._total, self._done = name, unit, total, 0
        LOGGER.info("%s: %s %s", name, total or "some", unit)
        self._said_s = time.monotonic()

    def on_step(self, step: Step) -> None:
        self._done += 1
        if time.monotonic() - self._said_s >= _COUNT_EVERY_S:
            of = f" of {self._total}" if self._total else ""
            LOGGER.info("%s: %d%s %s %s", self._name, self._done, of, self._unit, step.state)
            self._said_s = time.monotonic()

    def on_stage(self, name: str) -> None:
        LOGGER.info("%s", name)

    def on_finish(self) -> None:
        LOGGER.debug("%s: %d %s done", self._name, self._done, self._unit)


_SHOWN: Final[ContextVar[Progress]] = ContextVar("progress", default=_Logged())  # noqa: B039
_STAGE: Final = ContextVar("stage", default="")


@contextmanager
def showing(progress: Progress) -> Iterator[None]:
    """Tell ``progress`` what is done in the body of a ``with`` statement, in this thread."""
    token = _SHOWN.set(progress)
    try:
        yield
    finally:
        _SHOWN.reset(token)


def stage(name: str) -> None:
    """Say that a stage begins, in words for people; it lasts until the next one, "" = no stage."""
    _STAGE.set(name)
    _SHOWN.get().on_stage(name)


@contextmanager
def series(name: str, total: int, unit: str = "frames") -> Iterator[Progress]:
    """Begin a series of ``total`` items (0 = unknown), named as the stage by default; end it."""
    shown = _SHOWN.get()
    shown.on_start(name or _STAGE.get(), total, unit)
    try:
        yield shown
    finally:
        shown.on_finish()


@dataclass(frozen=True)
class Counted:
    """An item of which nothing but its number is to be said; a `Step`."""

    seconds: float
    ok: bool = True
    state: str = ""

    @property
    def event(self) -> Mapping[str, Any]:
        return {"event": "step", "seconds": round(self.seconds, 3)}


def tracked(
    items: Iterable[Item], unit: str, name: str = "", *, total: int | None = None
) -> Iterator[Item]:
    """Yield items, ``total`` or as many as they have, each counted when the next is wanted."""
    count = total or (len(items) if isinstance(items, Sized) else 0)
    with series(name, count, unit) as shown:
        before = time.perf_counter()
        for item in items:
            yield item
            now = time.perf_counter()
            shown.on_step(Counted(now - before))
            before = now
