"""Frames that have their pose are mapped behind: the newest is matched, those before it are not."""

from __future__ import annotations

from threading import Event

import numpy as np
import pytest

from recon.core.errors import MappingError
from recon.core.values import RectifiedCamera, RectifiedPair
from recon.map.drive.map_behind import MapBehind, Registered
from recon.odometry.protocol import OdometryHealth, OdometryResult
from tests.scenery.patience import LONG_S

GREY = np.zeros((16, 16), np.uint8)
CAMERA = RectifiedCamera(10.0, 8.0, 8.0, 8.0, 0.5, 16, 16)


class Counted:
    """What a live source tells of itself."""

    unmatched = 0

    def leave_unmatched(self) -> None:
        self.unmatched += 1


class Mapper:
    """Maps a frame when it may, and notes which was matched."""

    def __init__(self) -> None:
        self.done: list[tuple[int, bool]] = []
        self.begun, self.go = Event(), Event()

    def __call__(self, registered: Registered, matched: bool) -> None:
        self.begun.set()
        self.go.wait(LONG_S)
        self.done.append((registered.pair.index, matched))


def _frame(index: int) -> Registered:
    pair = RectifiedPair(GREY, GREY, CAMERA, index=index)
    return Registered(pair, OdometryResult(np.eye(4), OdometryHealth()))


def test_of_frames_that_wait_the_newest_is_matched() -> None:
    source, mapper = Counted(), Mapper()
    behind = MapBehind(source, mapper)
    behind.add(_frame(0))
    mapper.begun.wait(LONG_S)
    for index in range(1, 5):
        behind.add(_frame(index))

    mapper.go.set()
    behind.wait()
    behind.stop()

    assert mapper.done == [(0, True), (1, False), (2, False), (3, False), (4, True)]
    assert source.unmatched == 3


def test_the_first_frame_is_matched_however_late_it_is() -> None:
    source, mapper = Counted(), Mapper()
    mapper.go.set()
    behind = MapBehind(source, mapper)
    with behind._news:
        behind._waiting.extend(_frame(index) for index in range(3))
        behind._news.notify_all()

    behind.wait()
    behind.stop()

    assert mapper.done == [(0, True), (1, False), (2, True)]


def test_what_goes_wrong_is_raised_where_frames_are_added() -> None:
    def fail(registered: Registered, matched: bool) -> None:
        begun.set()
        raise MappingError("no")

    begun = Event()
    behind = MapBehind(Counted(), fail)
    with behind._news:
        behind._waiting.append(_frame(0))
        behind._news.notify_all()
    begun.wait(LONG_S)

    with pytest.raises(MappingError, match="no"):
        behind.wait()
    with pytest.raises(MappingError, match="no"):
        behind.add(_frame(1))
    behind.stop()


def test_frames_that_wait_are_forgotten_when_it_is_stopped() -> None:
    mapper = Mapper()
    behind = MapBehind(Counted(), mapper)
    behind.add(_frame(0))
    mapper.begun.wait(LONG_S)
    behind.add(_frame(1))
    mapper.go.set()

    behind.stop()

    assert mapper.done in ([(0, True)], [(0, True), (1, True)])
