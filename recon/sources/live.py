"""A source whose images arrive in their own time: from cameras, or a recording that is played."""

from __future__ import annotations

import time
from collections import deque
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from threading import Condition, Thread
from typing import Any, Final

import numpy as np

from recon.core.errors import SourceError
from recon.core.text import counted
from recon.core.values import StereoPair
from recon.run.progress import Progress, Step
from recon.sources.source import DerivedSource, StereoSource

_WAITING: Final = 1
"""Pairs that may wait; where another comes, the oldest is dropped. With one, a slow consumer always
gets the newest pair, and what is dropped is spread evenly."""

_PATIENCE_S: Final = 0.2
"""How long to wait for a pair before asking whether to stop."""


@dataclass(frozen=True)
class _Arrived:
    """A pair, and when it arrived (`time.monotonic`)."""

    pair: StereoPair
    due_s: float


class LiveSource(DerivedSource):
    """Hands over the pairs of a source when they are due; what comes too fast is left out.

    A thread reads each pair and hands it over when it is due. Where the consumer is not ready, one
    pair waits, and the next takes its place: the older one is dropped.

    Args:
        source: A recording, or cameras.
        rate: How many times as fast as recorded it is played; None = it is not recorded, and pairs
            are due when they were taken, by the clock of `time.monotonic`.
        stopped: Asked now and then; True ends the drive.
    """

    def __init__(
        self,
        source: StereoSource,
        rate: float | None = 1.0,
        stopped: Callable[[], bool] = lambda: False,
    ) -> None:
        super().__init__(source)
        self.rate = rate
        self._stopped = stopped
        self._waiting: deque[_Arrived] = deque()
        self._news = Condition()
        self._ended = False
        self._error: BaseException | None = None
        self._due_s: list[float] = []
        self._latency_s: list[float] = []
        self._unmatched = 0
        self.dropped = 0

    @property
    def description(self) -> str:
        """That of the source, and how it is played."""
        if self.rate is None:
            return self.source.description
        return f"{self.source.description}, played at {self.rate:g} times its speed"

    def __len__(self) -> int:
        """Return the number of pairs, if none is dropped."""
        return len(self.source)

    def frames(self, start: int = 0) -> Iterator[StereoPair]:
        """Yield the pairs as they arrive, those that are not dropped; once."""
        Thread(target=self._play, args=(start,), name="live", daemon=True).start()
        try:
            while (arrived := self._take()) is not None:
                yield arrived.pair
        finally:
            self._ended = True

    @property
    def waits(self) -> bool:
        """Whether the next pair is there already: the consumer is late."""
        return bool(self._waiting)

    def leave_unmatched(self) -> None:
        """Note that there is no time to match a pair that was yielded."""
        self._unmatched += 1

    def timed(self, progress: Progress) -> Progress:
        """Return a progress that notes when the result of each frame is there."""
        return _Timed(self, progress)

    def done(self, index: int) -> None:
        """Note that the result of a frame that was yielded is there."""
        self._latency_s.append(time.monotonic() - self._due_s[index])

    def figures(self) -> dict[str, Any]:
        """Return what was late and what was left out."""
        latency_ms = 1e3 * np.array(self._latency_s or [np.nan])
        p50, p95 = np.percentile(latency_ms, (50, 95)).tolist()
        known = bool(self._latency_s)
        return {
            "rate": self.rate,
            "frames_arrived": len(self._due_s) + self.dropped,
            "frames_dropped": self.dropped,
            "frames_not_matched": self._unmatched,
            "latency_ms": {
                name: round(value, 1) if known else None
                for name, value in (("p50", p50), ("p95", p95), ("max", float(latency_ms.max())))
            },
        }

    def warnings(self) -> list[str]:
        """Return what was left out, in words."""
        lines = []
        if self._unmatched:
            what = "only tracked, not matched: the map lacks what they saw"
            lines.append(f"{counted(self._unmatched, 'frame')} came too fast, {what}")
        if self.dropped:
            lines.append(f"{counted(self.dropped, 'frame')} came too fast, dropped")
        return lines

    def _play(self, start: int) -> None:
        """Hand over each pair when it is due."""
        begun_s, first_s = time.monotonic(), None
        try:
            for pair in self.source.frames(start):
                first_s = pair.timestamp_s if first_s is None else first_s
                due_s = pair.timestamp_s
                if self.rate is not None:
                    due_s = begun_s + (pair.timestamp_s - first_s) / self.rate
                time.sleep(max(0.0, due_s - time.monotonic()))
                if self._ended:
                    return
                self._put(_Arrived(pair, due_s))
        except BaseException as error:  # noqa: BLE001 - raised where the pairs are taken
            self._error = error
        finally:
            with self._news:
                self._ended = True
                self._news.notify()

    def _put(self, arrived: _Arrived) -> None:
        with self._news:
            if len(self._waiting) == _WAITING:
                self._waiting.popleft()
                self.dropped += 1
            self._waiting.append(arrived)
            self._news.notify()

    def _take(self) -> _Arrived | None:
        """Wait for the next pair; None = there is none any more."""
        with self._news:
            while not (self._waiting or self._ended or self._stopped()):
                self._news.wait(_PATIENCE_S)
            if self._stopped():
                if not self._due_s:
                    raise SourceError("the drive was stopped before its first frame")
                return None
            if not self._waiting:
                if self._error is not None:
                    raise self._error
                return None
            arrived = self._waiting.popleft()
        self._due_s.append(arrived.due_s)
        return arrived


class _Timed:
    """A progress that tells a live source when the result of a frame is there."""

    def __init__(self, source: LiveSource, shown: Progress) -> None:
        self._source = source
        self._shown = shown
        self._done = 0

    def on_start(self, name: str, total: int, unit: str = "frames") -> None:
        self._shown.on_start(name, total, unit)

    def on_step(self, step: Step) -> None:
        self._source.done(self._done)
        self._done += 1
        self._shown.on_step(step)

    def on_stage(self, name: str) -> None:
        self._shown.on_stage(name)

    def on_finish(self) -> None:
        self._shown.on_finish()
