"""A source whose images arrive in their own time: from cameras, or a recording that is played."""

from __future__ import annotations

import time
from collections import deque
from collections.abc import Callable, Iterator
from threading import Condition, Thread
from typing import Final

import numpy as np

from recon.core.errors import SourceError
from recon.core.text import counted
from recon.core.values import Recorded
from recon.sources.source import DerivedSource, Latency, LiveFigures, SourceFigures, StereoSource

# Pairs that may wait; where another comes, the oldest is dropped. With one, a slow consumer always
# gets the newest pair, and what is dropped is spread evenly.
_WAITING: Final = 1
_PATIENCE_S: Final = 0.2  # how long to wait for a pair before asking whether to stop


class LiveSource(DerivedSource):
    """The pairs of a source when they are due, read by a thread; of those that wait, the newest.

    ``rate`` is how many times as fast as recorded it is played; None = pairs are due when they were
    taken, by `time.monotonic`. Where ``stopped()`` is True the drive ends.
    """

    live = True

    def __init__(
        self,
        source: StereoSource,
        rate: float | None = 1.0,
        stopped: Callable[[], bool] = lambda: False,
    ) -> None:
        super().__init__(source)
        if rate is not None:
            self.description += f", played at {rate:g} times its speed"
        self.rate = rate
        self._stopped = stopped
        self._waiting: deque[tuple[Recorded, float]] = deque()
        self._news = Condition()
        self._ended = False
        self._error: BaseException | None = None
        self._due_s: list[float] = []
        self._latency_s: list[float] = []
        self._unmatched = 0
        self.dropped = 0

    def __len__(self) -> int:
        return len(self.source)

    def frames(self, start: int = 0) -> Iterator[Recorded]:
        Thread(target=self._play, args=(start,), name="live", daemon=True).start()
        try:
            while (pair := self._take()) is not None:
                yield pair
        finally:
            self._ended = True

    def hurried(self) -> bool:
        return bool(self._waiting)

    def note_unmatched(self) -> None:
        self._unmatched += 1

    def note_located(self, index: int) -> None:
        """Measure the time from the arrival of a pair to its pose."""
        self._latency_s.append(time.monotonic() - self._due_s[index])

    def figures(self) -> SourceFigures:
        latency_ms = Latency(None, None, None)
        if self._latency_s:
            found = np.percentile(1e3 * np.array(self._latency_s), [50, 95, 100]).tolist()
            latency_ms = Latency(*(round(value, 1) for value in found))
        live = LiveFigures(
            rate=self.rate,
            frames_arrived=len(self._due_s) + self.dropped,
            frames_dropped=self.dropped,
            frames_not_matched=self._unmatched,
            latency_ms=latency_ms,
        )
        return SourceFigures(live=live)

    def warnings(self) -> list[str]:
        lines = []
        if self._unmatched:
            what = "only tracked, not matched: the map lacks what they saw"
            lines.append(f"{counted(self._unmatched, 'frame')} came too fast, {what}")
        if self.dropped:
            lines.append(f"{counted(self.dropped, 'frame')} came too fast, dropped")
        return lines

    def _play(self, start: int) -> None:
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
                self._put(pair, due_s)
        except BaseException as error:  # noqa: BLE001 - raised where the pairs are taken
            self._error = error
        finally:
            with self._news:
                self._ended = True
                self._news.notify()

    def _put(self, pair: Recorded, due_s: float) -> None:
        with self._news:
            if len(self._waiting) == _WAITING:
                self._waiting.popleft()
                self.dropped += 1
            self._waiting.append((pair, due_s))
            self._news.notify()

    def _take(self) -> Recorded | None:
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
            pair, due_s = self._waiting.popleft()
        self._due_s.append(due_s)
        return pair
