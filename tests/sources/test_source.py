"""Sources of one's own, parts of a source, rendered streets, and drives that arrive live."""

import time
from collections.abc import Callable, Iterator
from pathlib import Path
from threading import Event
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest

import recon
from recon.core.errors import FormatError, SourceError
from recon.core.values import RectifiedCamera, StereoPair
from recon.map.localize.sequence import localize_sequence
from recon.rig.audit import audit_source
from recon.sources.live import LiveSource
from recon.sources.source import SourcePart, StereoSource
from recon.sources.synthetic import SyntheticSource
from recon.street.settings import StreetScene, StreetSettings
from tests.scenery.film import RIG, Film, film
from tests.scenery.patience import LONG_S


class Own(recon.StereoSource):
    """No more than has to be there."""

    def __init__(self, street: Film) -> None:
        self.calibration, self.street = street.calibration, street

    def __len__(self) -> int:
        return len(self.street)

    def frames(self, start: int = 0) -> Iterator[StereoPair]:
        return self.street.frames(start)


@pytest.fixture(scope="module")
def own():
    return Own(film(StreetScene(frames=3, seed=1, **RIG)))


def test_a_subclass_is_mapped_and_has_defaults_for_the_rest(own):
    mapped = recon.map_sequence(own, recon.load_config())
    assert len(mapped.trajectory) == 3
    assert repr(own) == "Own(Own, pairs: 3, a source)"
    assert (own.files, own.truth, own.stamps_s, own.left_out) == ((), None, None, 0)
    assert (own.live, own.lead, own.hurried()) == (False, 0, False)
    assert (own.warnings(), own.figures().to_json()) == ([], {})
    assert [own.lines(count) for count in (2, 3, 4)] == [None, [0, 1, 2], [0, 1, 2]]


def test_a_part_has_the_pairs_of_its_range(own):
    part = SourcePart(own, 1, 3, lead=1)
    assert repr(part) == "SourcePart(Own 1 to 2, pairs: 2, a source)"
    assert ([p.index for p in part], [p.index for p in part.frames(1)]) == ([1, 2], [2])
    assert part.lead == 1


CALLS: dict[str, Callable[[Any], Any]] = {
    "map_sequence": lambda source: recon.map_sequence(source, recon.load_config()),
    "run_map": lambda source: recon.run_map(source, options=recon.MapOptions(audit=False)),
    "run_live": recon.run_live,
    "run_audit": lambda source: recon.run_audit(source, recon.load_config()),
    "audit_source": lambda source: audit_source(source, recon.load_config()),
    "localize_sequence": lambda source: localize_sequence(source, None, None),  # type: ignore[arg-type]
}


@pytest.mark.parametrize("call", CALLS)
@pytest.mark.parametrize("other", [Path("drive"), SimpleNamespace(frames=list, name="mine")])
def test_anything_else_is_refused_in_one_line(call, other):
    with pytest.raises(SourceError, match=r"subclass of recon\.StereoSource") as refused:
        CALLS[call](other)
    assert type(other).__name__ in str(refused.value)


@pytest.fixture(scope="module")
def street():
    scene = StreetSettings(frames=3, seed=6, width_px=160, height_px=80, focal_px=90.0)
    return SyntheticSource(scene)


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


def test_who_keeps_up_gets_every_pair():
    recording = Recording(6)
    recording.go.set()
    live = LiveSource(recording, rate=2.0)
    begun = time.perf_counter()
    pairs = list(live)
    assert time.perf_counter() - begun >= 0.25  # five gaps of 50 ms
    figures = live.figures().to_json()["live"]
    assert [pair.index for pair in pairs] == [0, 1, 2, 3, 4, 5][-len(pairs) :]
    assert figures["frames_arrived"] == 6
    assert len(pairs) + figures["frames_dropped"] == 6


def test_who_is_slow_gets_the_newest_and_is_told_what_was_dropped():
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
    figures = live.figures().to_json()["live"]
    counts = [figures[f"frames_{what}"] for what in ("arrived", "dropped", "not_matched")]
    assert counts == [10, 8, 1]
    assert [text.split()[0] for text in live.warnings()] == ["1", "8"]


def test_the_time_from_arrival_to_result_is_measured_of_drives_that_are_played():
    live = LiveSource(Recording(1))
    assert live.figures().to_json()["live"]["latency_ms"] == {"p50": None, "p95": None, "max": None}
    assert live.warnings() == []
    for _ in live:
        time.sleep(0.02)
        live.note_located(0)
    latency_ms = live.figures().to_json()["live"]["latency_ms"]
    assert 20 <= latency_ms["p50"] <= latency_ms["p95"] <= latency_ms["max"]


def test_an_error_of_the_recording_is_raised_where_pairs_are_taken():
    recording = Recording(2, FormatError("truncated"))
    recording.go.set()
    with pytest.raises(FormatError, match="truncated"):
        list(LiveSource(recording, rate=1e9))
