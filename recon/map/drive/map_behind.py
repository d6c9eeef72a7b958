"""Live mapping: poses come first; frames are matched later, as far as there is time."""

from __future__ import annotations

from collections import deque
from collections.abc import Callable, Generator
from threading import Condition, Thread
from typing import Final

import numpy as np

from recon.core.values import RectifiedPair
from recon.map.drive.mapper import FrameResult
from recon.odometry.protocol import OdometryFrame, OdometryResult
from recon.run.threads import work_in_background
from recon.sources.source import StereoSource
from recon.stereo.frame import FrameReconstructor

_MOST_WAITING: Final = 20
"""Most frames that wait to be mapped; the next pose waits, too, then. So many wait only while the
disk hangs."""


_Registered = tuple[RectifiedPair, OdometryResult]
MapFrame = Callable[[RectifiedPair, OdometryResult, bool], None]
"""Puts a frame that has its pose into the map, matched or not."""


def poses_first(
    source: StereoSource,
    reconstructor: FrameReconstructor,
    register: Callable[[OdometryFrame], OdometryResult],
    map_frame: MapFrame,
) -> Generator[FrameResult]:
    """Yield the pose of each frame as soon as it is known, by odometry on rough disparities.

    Args:
        source: Where the pairs come from.
        reconstructor: Rectifies and matches them.
        register: Finds the pose of the next frame.
        map_frame: Puts a frame into the map, matched or not; called in another thread, in order.
    """
    behind = MapBehind(source, map_frame)
    try:
        for index, pair in enumerate(source.frames()):
            rectified, disparity = reconstructor.match_roughly(pair)
            found = register(OdometryFrame(rectified, disparity, rough=True))
            source.note_located(index)
            valid_share = float(np.mean(disparity.valid))
            T = found.T_world_camera
            yield FrameResult(index, len(source), 0.0, valid_share, 0, T, found.health)
            behind.add((rectified, found))
        behind.wait()
    finally:
        behind.stop()


class MapBehind:
    """Maps frames behind their poses, in a thread of lower priority.

    When a frame is done, the newest frame that waits is matched; older ones are mapped unmatched,
    which takes no time. So matching uses the time that poses leave, and delays none of them.

    Args:
        source: Where the frames come from; it counts what is not matched.
        map_frame: Puts a frame into the map, matched or not.
    """

    def __init__(self, source: StereoSource, map_frame: MapFrame) -> None:
        self._source = source
        self._map_frame = map_frame
        self._waiting: deque[_Registered] = deque()
        self._news = Condition()
        self._busy = self._ended = False
        self._error: BaseException | None = None
        self._mapped = 0
        self._thread = Thread(target=self._work, name="map-behind", daemon=True)
        self._thread.start()

    def add(self, registered: _Registered) -> None:
        """Add the next frame."""
        with self._news:
            self._news.wait_for(lambda: len(self._waiting) < _MOST_WAITING or self._error)
            self._waiting.append(registered)
            self._news.notify_all()
        self._raise()

    def wait(self) -> None:
        """Wait until all frames are mapped, the newest of them matched."""
        with self._news:
            self._news.wait_for(lambda: not (self._waiting or self._busy) or self._error)
        self._raise()

    def stop(self) -> None:
        """End the thread after the frame that it works on; others that wait are forgotten."""
        with self._news:
            self._waiting.clear()
            self._ended = True
            self._news.notify_all()
        self._thread.join()

    def _raise(self) -> None:
        if self._error is not None:
            raise self._error

    def _work(self) -> None:
        work_in_background()
        try:
            while batch := self._take():
                for registered in batch:
                    self._map(registered, last=registered is batch[-1])
        except BaseException as error:  # noqa: BLE001 - raised where frames are added
            self._error = error
        finally:
            with self._news:
                self._busy = False
                self._news.notify_all()

    def _take(self) -> list[_Registered]:
        """Wait for frames; empty = there are none any more."""
        with self._news:
            self._busy = False
            self._news.notify_all()
            self._news.wait_for(lambda: self._waiting or self._ended)
            batch, self._busy = list(self._waiting), True
            self._waiting.clear()
            self._news.notify_all()
        return batch

    def _map(self, registered: _Registered, *, last: bool) -> None:
        # The first frame says where the ground is, and with it the axes of the map.
        matched = last or not self._mapped
        if not matched:
            self._source.note_unmatched()
        self._map_frame(*registered, matched)
        self._mapped += 1
