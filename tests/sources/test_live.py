"""A live source hands over pairs as they arrive; it keeps up by leaving out, and counts what."""

from __future__ import annotations

import time
from collections.abc import Iterator
from threading import Event

import numpy as np
import pytest

from recon.core.errors import FormatError
from recon.core.values import RectifiedCamera, StereoPair
from recon.run.progress import SILENT
from recon.sources import live as live_file
from recon.sources.live import LiveSource

GREY = np.zeros((16, 16), np.uint8)


class Recording:
    """Pairs 0.1 s apart; the first one is read, then all others once `go` is set."""

    name, description, files, truth = "recording", "a recording", (), None
    calibration = RectifiedCamera(10.0, 8.0, 8.0, 8.0, 0.5, 16, 16)

    def __init__(self, pairs: int, error: Exception | None = None) -> None:
        self.pairs, self.error = pairs, error
        self.go, self.read = Event(), Event()

    def __len__(self) -> int:
        return self.pairs

    def __iter__(self) -> Iterator[StereoPair]:
        return self.frames()

    def frames(self, start: int = 0) -> Iterator[StereoPair]:
        for index in range(start, self.pairs):
            if index == 1:
                self.go.wait(10)
            yield StereoPair(GREY, GREY, 7.0 + 0.1 * index, index)
        self.read.set()
        if self.error is not None:
            raise self.error


def test_who_keeps_up_gets_every_pair() -> None:
    recording = Recording(6)
    recording.go.set()
    live = LiveSource(recording, rate=2.0)

    begun = time.perf_counter()
    pairs = list(live)

    assert time.perf_counter() - begun >= 0.25  # five gaps of 50 ms
    figures = live.figures()
    assert [pair.index for pair in pairs] == [0, 1, 2, 3, 4, 5][-len(pairs) :]
    assert figures["frames_arrived"] == 6
    assert len(pairs) + figures["frames_dropped"] == 6


def test_who_is_slow_loses_the_oldest_and_is_told_to_hurry() -> None:
    recording = Recording(10)
    live = LiveSource(recording, rate=1e9)
    pairs = live.frames()

    first = next(pairs)
    recording.go.set()
    recording.read.wait(10)
    rest = list(pairs)

    assert [pair.index for pair in (first, *rest)] == [0, 7, 8, 9]
    assert [live.hurried(pair) for pair in (first, *rest)] == [False, True, True, False]
    figures = live.figures()
    assert figures["frames_arrived"] == 10
    assert figures["frames_dropped"] == 6
    assert figures["frames_not_matched"] == 2
    assert [text.split()[0] for text in live.warnings()] == ["2", "6"]


def test_of_pairs_that_hurry_every_third_is_matched(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(live_file, "_WAITING", 20)
    recording = Recording(10)
    live = LiveSource(recording, rate=1e9)
    pairs = live.frames()
    next(pairs)
    recording.go.set()
    recording.read.wait(10)

    hurried = [live.hurried(pair) for pair in pairs]

    assert hurried == [True, True, False, True, True, False, True, True, False]


def test_the_time_from_arrival_to_result_is_measured() -> None:
    live = LiveSource(Recording(1))
    progress = live.timed(SILENT)

    for _ in live:
        time.sleep(0.02)
        progress.on_step(None)

    latency_ms = live.figures()["latency_ms"]
    assert 20 <= latency_ms["p50"] <= latency_ms["p95"] <= latency_ms["max"]


def test_nothing_is_said_of_a_drive_that_was_never_played() -> None:
    live = LiveSource(Recording(3))

    assert live.figures()["latency_ms"] == {"p50": None, "p95": None, "max": None}
    assert live.warnings() == []


def test_an_error_of_the_recording_is_raised_where_pairs_are_taken() -> None:
    recording = Recording(2, FormatError("truncated"))
    recording.go.set()

    with pytest.raises(FormatError, match="truncated"):
        list(LiveSource(recording, rate=1e9))
