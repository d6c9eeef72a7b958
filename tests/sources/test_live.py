"""A live source hands over pairs as they arrive; it keeps up by leaving out, and counts what."""

from __future__ import annotations

import time
from collections.abc import Iterator
from threading import Event

import numpy as np
import pytest

from recon.core.errors import FormatError
from recon.core.values import RectifiedCamera, StereoPair
from recon.sources.live import LiveSource
from recon.sources.source import StereoSource
from tests.scenery.patience import LONG_S

GREY = np.zeros((16, 16), np.uint8)


class Recording(StereoSource):
    """Pairs 0.1 s apart; the first one is read, then all others once `go` is set."""

    name, description = "recording", "a recording"
    calibration = RectifiedCamera(10.0, 8.0, 8.0, 8.0, 0.5, 16, 16)

    def __init__(self, pairs: int, error: Exception | None = None) -> None:
        self.pairs, self.error = pairs, error
        self.go, self.read = Event(), Event()

    def __len__(self) -> int:
        return self.pairs

    def frames(self, start: int = 0) -> Iterator[StereoPair]:
        for index in range(start, self.pairs):
            if index == 1:
                self.go.wait(LONG_S)
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
    figures = live.figures()["live"]
    assert [pair.index for pair in pairs] == [0, 1, 2, 3, 4, 5][-len(pairs) :]
    assert figures["frames_arrived"] == 6
    assert len(pairs) + figures["frames_dropped"] == 6


def test_who_is_slow_gets_the_newest_and_is_told_what_was_dropped() -> None:
    recording = Recording(10)
    live = LiveSource(recording, rate=1e9)
    pairs = live.frames()

    first = next(pairs)
    recording.go.set()
    recording.read.wait(LONG_S)
    while live.dropped < 8:  # the last pair is handed over after it was read
        time.sleep(0.001)
    assert live.hurried()
    rest = list(pairs)

    assert [pair.index for pair in (first, *rest)] == [0, 9]
    assert not live.hurried()
    live.note_unmatched()
    figures = live.figures()["live"]
    assert figures["frames_arrived"] == 10
    assert figures["frames_dropped"] == 8
    assert figures["frames_not_matched"] == 1
    assert [text.split()[0] for text in live.warnings()] == ["1", "8"]


def test_pairs_of_cameras_are_due_when_they_were_taken() -> None:
    class Camera(Recording):
        def frames(self, start: int = 0) -> Iterator[StereoPair]:
            yield StereoPair(GREY, GREY, time.monotonic() - 0.05, 0)

    live = LiveSource(Camera(1), rate=None)

    for _ in live:
        live.note_located(0)

    assert 50 <= live.figures()["live"]["latency_ms"]["p50"] < 1000 * LONG_S
    assert live.figures()["live"]["rate"] is None
    assert live.description == "a recording"


def test_a_drive_ends_when_it_is_told_to() -> None:
    stop = Event()
    recording = Recording(3)  # after the first pair it gives none
    pairs = LiveSource(recording, stopped=stop.is_set).frames()
    next(pairs)

    stop.set()

    assert list(pairs) == []
    recording.go.set()


def test_the_time_from_arrival_to_result_is_measured() -> None:
    live = LiveSource(Recording(1))

    for _ in live:
        time.sleep(0.02)
        live.note_located(0)

    latency_ms = live.figures()["live"]["latency_ms"]
    assert 20 <= latency_ms["p50"] <= latency_ms["p95"] <= latency_ms["max"]


def test_nothing_is_said_of_a_drive_that_was_never_played() -> None:
    live = LiveSource(Recording(3))

    assert live.figures()["live"]["latency_ms"] == {"p50": None, "p95": None, "max": None}
    assert live.warnings() == []


def test_an_error_of_the_recording_is_raised_where_pairs_are_taken() -> None:
    recording = Recording(2, FormatError("truncated"))
    recording.go.set()

    with pytest.raises(FormatError, match="truncated"):
        list(LiveSource(recording, rate=1e9))
