"""A recording played at its own time stamps, as if its images came from the cameras just now."""

from __future__ import annotations

import time
from collections import deque
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path
from threading import Condition, Thread
from typing import Any, Final

import numpy as np

from recon.core.values import RectifiedCamera, StereoCalibration, StereoPair
from recon.run.progress import Progress, Step
from recon.sources.protocol import StereoSource

_WAITING: Final = 3
"""Pairs that may wait; where more come, the oldest is left out."""

_UNMATCHED: Final = 2
"""Most pairs in a row that are not matched: tracking needs new points, and the map something."""


@dataclass(frozen=True)
class _Arrived:
    """A pair, and when it arrived (on the clock of the process)."""

    pair: StereoPair
    due_s: float


class LiveSource:
    """Plays a source at its own time stamps; keeps up by leaving out, and counts what.

    A thread reads each pair and hands it over when it is due. Where the consumer is behind, pairs
    wait, but never more than a few. One behind which another waits already is `hurried`: it should
    be tracked without being matched, but every third one is not. Where even that is too slow, the
    oldest are dropped.

    Args:
        source: The recording.
        rate: How many times as fast as recorded it is played.
    """

    truth = None

    def __init__(self, source: StereoSource, rate: float = 1.0) -> None:
        self._source = source
        self.rate = rate
        self._waiting: deque[_Arrived] = deque()
        self._news = Condition()
        self._ended = False
        self._error: BaseException | None = None
        self._due_s: list[float] = []
        self._hurried: set[int] = set()
        self._in_a_row = 0
        self._latency_s: list[float] = []
        self._dropped = 0

    @property
    def name(self) -> str:
        """That of the recording."""
        return self._source.name

    @property
    def description(self) -> str:
        """That of the recording, and how it is played."""
        return f"{self._source.description}, played at {self.rate:g} times its speed"

    @property
    def calibration(self) -> RectifiedCamera | StereoCalibration:
        """That of the recording."""
        return self._source.calibration

    @property
    def files(self) -> Sequence[Path]:
        """Those of the recording."""
        return self._source.files

    def __len__(self) -> int:
        """Return the number of pairs, if none is dropped."""
        return len(self._source)

    def __iter__(self) -> Iterator[StereoPair]:
        """Yield the pairs, like ``frames()``."""
        return self.frames()

    def frames(self, start: int = 0) -> Iterator[StereoPair]:
        """Yield the pairs as they arrive, those that are not dropped; once.

        Raises:
            ReconError: A pair cannot be read.
        """
        Thread(target=self._play, args=(start,), name="live", daemon=True).start()
        try:
            while (arrived := self._take()) is not None:
                yield arrived.pair
        finally:
            self._ended = True

    def hurried(self, pair: StereoPair) -> bool:
        """Return whether a pair should not be matched: another one waited when it was taken."""
        return pair.index in self._hurried

    def timed(self, progress: Progress) -> Progress:
        """Return a progress that notes when the result of each frame is there."""
        return _Timed(self, progress)

    def done(self, index: int) -> None:
        """Note that the result of a frame that was yielded is there."""
        self._latency_s.append(time.perf_counter() - self._due_s[index])

    def figures(self) -> dict[str, Any]:
        """Return what was late and what was left out."""
        latency_ms = 1e3 * np.array(self._latency_s or [np.nan])
        p50, p95 = np.percentile(latency_ms, (50, 95)).tolist()
        known = bool(self._latency_s)
        return {
            "rate": self.rate,
            "frames_arrived": len(self._due_s) + self._dropped,
            "frames_dropped": self._dropped,
            "frames_not_matched": len(self._hurried),
            "latency_ms": {
                name: round(value, 1) if known else None
                for name, value in (("p50", p50), ("p95", p95), ("max", float(latency_ms.max())))
            },
        }

    def warnings(self) -> list[str]:
        """Return what was left out, in words."""
        lines = []
        if self._hurried:
            what = "tracked, but not matched: the map lacks what they saw"
            lines.append(f"{len(self._hurried)} frames came too fast and were {what}")
        if self._dropped:
            lines.append(f"{self._dropped} frames came too fast and were dropped")
        return lines

    def _play(self, start: int) -> None:
        """Hand over each pair when it is due."""
        begun_s, first_s = time.perf_counter(), None
        try:
            for pair in self._source.frames(start):
                first_s = pair.timestamp_s if first_s is None else first_s
                due_s = begun_s + (pair.timestamp_s - first_s) / self.rate
                time.sleep(max(0.0, due_s - time.perf_counter()))
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
                self._dropped += 1
            self._waiting.append(arrived)
            self._news.notify()

    def _take(self) -> _Arrived | None:
        """Wait for the next pair; None = there is none any more."""
        with self._news:
            self._news.wait_for(lambda: self._waiting or self._ended)
            if not self._waiting:
                if self._error is not None:
                    raise self._error
                return None
            arrived = self._waiting.popleft()
            self._in_a_row = self._in_a_row + 1 if self._waiting else 0
            if self._in_a_row % (_UNMATCHED + 1):
                self._hurried.add(arrived.pair.index)
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
