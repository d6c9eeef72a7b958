"""A drive while it is mapped: frames in, poses out, and a map on disk that grows.

Frames of a recording are matched ahead of their poses. While images arrive, poses come first, and
frames are matched behind them, as far as there is time.
"""

from __future__ import annotations

import time
from collections import deque
from collections.abc import Callable, Generator, Iterator, Mapping
from contextlib import contextmanager
from dataclasses import dataclass, field, replace
from pathlib import Path
from threading import Condition, Thread
from typing import Any, Final

import numpy as np

from recon.core.dates import Date
from recon.core.errors import FormatError, ReconError, RegistrationError
from recon.core.machine import versions
from recon.core.values import Rectified, Trajectory
from recon.core.values.arrays import tree_of
from recon.core.work import Stopwatch, look_ahead, work_in_background
from recon.io.files import reading
from recon.look.tracks import LiveTracks
from recon.map.builders import thin_rays
from recon.map.drive.drive_loops import DriveLoops, LoopWatch
from recon.map.drive.levelling import level_drive
from recon.map.drive.mapper import FrameResult, Mapper
from recon.map.listener import NOBODY, DriveBegun, DriveListener, PoseTeller
from recon.map.map import Map
from recon.map.occupancy.gone import texture_of
from recon.map.settings import DriveSettings
from recon.map.store.session import Session, SessionInfo
from recon.odometry.health import segment_numbers
from recon.odometry.imu import ImuGuide
from recon.odometry.protocol import OdometryFrame, OdometryResult
from recon.places.detector import LastView, NewViews
from recon.places.keyframe import coarse_of
from recon.sources.source import StereoSource, date_of
from recon.stereo.frame import FrameReconstructor, ReconstructedFrame

_COMMIT_S: Final = 3.0  # time between two commits of a drive whose images arrive just now


class Drive:
    """Couples the mapper with the search for loops, commits and timing.

    Goes on from the last commit if there is one; the time spent before it is included. ``sample``
    is the frame in the middle; None = it was mapped before this process started.
    """

    def __init__(
        self,
        source: StereoSource,
        reconstructor: FrameReconstructor,
        mapper: Mapper,
        loops: LoopWatch,
        config: DriveSettings,
        workspace: Workspace,
    ) -> None:
        self.source, self.reconstructor, self.config = source, reconstructor, config
        self.mapper, self.session = mapper, mapper.session
        self._total, self._threads = len(source), workspace.threads or 1
        self._loops, self._map = loops, workspace.map
        self._views = NewViews(reconstructor.camera)
        self._stage = workspace.stopwatch.stage
        self._listener, mount = workspace.listener, mapper.session.mount
        self._teller = PoseTeller(mount, config.scale)
        begun = DriveBegun(source, reconstructor.camera, self._map.store.path, False, mount)
        self._listener.on_begin(begun)
        self.sample: ReconstructedFrame | None = None
        self._saved = 0
        self._start = self._last = self._saved_s = time.perf_counter()
        with resuming(self._map.store.name):
            if (state := self.session.state()) is None:
                return
            self.mapper.restore(state["mapper"])
            if state.get("last_view") is not None:  # none of a drive put together of pieces
                self._views.last = LastView(**state["last_view"])
            if len(self.session):
                path, health = self.session.odometry, self.session.health
                self._loops.restore(path.T_world_camera, segment_numbers(health))
            self._saved, self._last = len(self.mapper), time.perf_counter()
            self._start = self._last - state["seconds"]

    def tell(self, frame: FrameResult) -> None:
        """Tell the listener where a frame is, once the map has axes."""
        if self.mapper.axes is not None and self._listener is not NOBODY:
            at = (frame.time_s, frame.T_world_camera, frame.health)
            self._listener.on_pose(self._teller.mapped(*at, *self.mapper.axes))

    def begin_at(self, frame: int) -> None:
        """Lay the axes of the map by the ground of a frame, and save what the odometry found."""
        pair = next(self.source.frames(frame))
        self.mapper.fix_axes(self.reconstructor.reconstruct(pair).cloud)
        self._save()

    def frames(self, tracks: LiveTracks | None = None) -> Generator[FrameResult]:
        """Yield the pose of each frame left; ``tracks`` keep what a live drive shows of its rig."""
        if self.source.live:
            return poses_first(
                self.source, self.reconstructor, self.mapper.register, self._map_behind, tracks
            )
        return self._in_order()

    def _in_order(self) -> Generator[FrameResult]:
        """Match ahead, find the pose, integrate."""
        pairs = map(self.reconstructor.rectify, self.source.frames(len(self.mapper)))
        for frame in look_ahead(self._reconstruct, pairs):
            found = self.mapper.register(OdometryFrame(frame.pair, frame.disparity))
            led = len(self.mapper) < self.source.lead
            yield self._add(frame.unmapped() if led else self._seen_anew(frame, found), found)

    def _seen_anew(self, frame: ReconstructedFrame, found: OdometryResult) -> ReconstructedFrame:
        """Match a view that shows something new again, if there is a matcher for it."""
        T, reconstructor = found.T_world_camera, self.reconstructor
        if not (reconstructor.matches_keyframes and found.health.ok):
            return frame
        if not self._views.is_new(frame.disparity, T):
            return frame
        anew = self._with_rays(reconstructor.reconstruct_keyframe(frame))
        self._views.last = LastView(coarse_of(anew.disparity), T)
        return anew

    def _map_behind(self, pair: Rectified, found: OdometryResult, matched: bool) -> None:
        self._add(self._reconstruct(pair) if matched else self.reconstructor.unmatched(pair), found)

    def _reconstruct(self, pair: Rectified) -> ReconstructedFrame:
        return self._with_rays(self.reconstructor.reconstruct_rectified(pair))

    def _with_rays(self, frame: ReconstructedFrame) -> ReconstructedFrame:
        with self._stage("thin"):
            rays = thin_rays(frame.cloud, self.config.occupancy)
            texture = texture_of(frame.pair.left, frame.pair.valid)
            return replace(frame, rays=replace(rays, texture=texture))

    def _add(self, frame: ReconstructedFrame, found: OdometryResult) -> FrameResult:
        result = self.mapper.add(frame, found, total=self._total)
        self._loops.add(frame, result.T_world_camera, result.segment)
        if result.index <= self._total // 2 and (self.sample is None or len(frame.cloud)):
            self.sample = frame
        due = len(self.mapper) - self._saved >= self.config.checkpoints.every_frames
        if self.source.live:
            due = time.perf_counter() - self._saved_s >= _COMMIT_S
        if due:
            self._save()
        self.config.memory.check(f"frame {result.index}")
        now = time.perf_counter()
        seconds, self._last = now - self._last, now
        return replace(result, seconds=seconds)

    def wait(self) -> None:
        """Wait for background work: the integration of the last frame, and the search for loops."""
        self.mapper.wait()
        self._loops.wait()
        self._last = time.perf_counter()

    def stop(self) -> None:
        """Stop background work, finished or not, and tell the listener."""
        self.mapper.abandon()
        self._loops.stop()
        self._listener.on_end()

    def finish(self) -> None:
        if not len(self.mapper):
            raise RegistrationError("the source has no frame")
        if len(self.mapper) > self._saved:
            self._save()
        self.mapper.close()

    def settle(self, path: Trajectory, guide: ImuGuide | None = None) -> DriveLoops | None:
        """Close the loops of the path, and make the map level by all of it, unless it arrived live.

        Returns the loops, which the map keeps; None = they are not looked for.
        """
        loops = None
        if self._loops.searching:
            with self._stage("close_loops"):
                loops = self._loops.close(path, self.session.health)
                self.session.set_loops(loops.record())
        if not self.source.live:
            with self._stage("level"):
                placed = self._map.placed.get(self.session.number, self.session.trusted)
                level_drive(self.session, self.config, placed, guide, self._threads)
        return loops

    def sample_again(self) -> ReconstructedFrame:
        """Reconstruct the frame in the middle, which was mapped before this process started."""
        index = min(self._total // 2, len(self.session) - 1)
        return self.reconstructor.reconstruct(next(self.source.frames(index)))

    @property
    def seconds(self) -> float:
        """Time from the first frame to the last."""
        return self._last - self._start

    def _save(self) -> None:
        if self._map.store.path is None:
            return
        self.wait()  # else keyframes that a resumed run needs might be missing
        with self._stage("checkpoint"):
            if self.source.live:
                self.mapper.close()  # not to be resumed: frames that were dropped do not come again
            else:
                seconds = time.perf_counter() - self._start
                last_view = tree_of(self._views.last)
                state = {"mapper": self.mapper.state(), "seconds": seconds, "last_view": last_view}
                self.session.set_state(state)
            self._map.commit()
        self._listener.on_map()
        self._saved, self._saved_s = len(self.mapper), time.perf_counter()


_MOST_WAITING: Final = 20
"""Most frames that wait to be mapped; the next pose waits, too, then. So many wait only while the
disk hangs."""


_Registered = tuple[Rectified, OdometryResult]
MapFrame = Callable[[Rectified, OdometryResult, bool], None]
"""Puts a frame that has its pose into the map, matched or not."""


def poses_first(
    source: StereoSource,
    reconstructor: FrameReconstructor,
    register: Callable[[OdometryFrame], OdometryResult],
    map_frame: MapFrame,
    tracks: LiveTracks | None = None,
) -> Generator[FrameResult]:
    """Yield each pose as soon as it is known, by odometry on rough disparities.

    ``map_frame`` is called in another thread, in order; ``tracks`` keep what shows the rig.
    """
    behind = MapBehind(source, map_frame)
    try:
        for index, pair in enumerate(source.frames()):
            rectified, disparity = reconstructor.match_roughly(pair)
            frame = OdometryFrame(rectified, disparity, rough=True)
            found = register(frame)
            source.note_located(index)
            valid_ratio = float(np.mean(disparity.measured))
            T = found.T_world_camera
            about = (index, len(source), 0.0, valid_ratio, 0, T, found.health)
            yield FrameResult(*about, time_s=rectified.timestamp_s)
            behind.add((rectified, found))
            if source.patient:
                behind.wait()
            if tracks is not None:
                tracks.add(index, frame, found)
        behind.wait()
    finally:
        behind.stop()


class MapBehind:
    """Maps frames behind their poses, in a thread of lower priority.

    When a frame is done, the newest frame that waits is matched; older ones are mapped unmatched,
    which takes no time. So matching uses the time that poses leave, and delays none of them.
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


ANEW: Final = "start the run anew, without --resume"


@dataclass(frozen=True)
class Workspace:
    """What a drive is mapped with, none of which affects the result."""

    # The map whose last session the drive goes on with, or which it becomes a session of; it must
    # stay open as long as the result is used
    map: Map = field(default_factory=Map.temporary)
    stopwatch: Stopwatch = field(default_factory=Stopwatch)  # times each stage
    threads: int | None = None  # threads of the matcher; None = all cores
    listener: DriveListener = NOBODY  # is told of the drive while it goes on
    # Of the left camera above the ground, where the map that is searched knows it
    camera_height_m: float | None = None

    def session(self, source: StereoSource, config: DriveSettings) -> Session:
        """Return the session of a drive: the last one of the map, or a new one."""
        last = self.map.sessions[-1] if self.map.sessions else None
        return self.map.begin(session_info(source, config)) if last is None else last


@contextmanager
def resuming(where: str | Path) -> Iterator[None]:
    """Say in errors about an unfinished map that the run has to start anew."""
    try:
        with reading(where):
            yield
    except ReconError as error:
        raise FormatError(error.what, where=where, got=error.got, hint=ANEW) from error


def session_info(
    source: StereoSource,
    config: DriveSettings,
    start: Mapping[str, Any] | None = None,
    given: Date | None = None,
) -> SessionInfo:
    """Return what a session is a drive of; ``start`` is what a run is begun with, to resume it.

    Its date is the ``given`` one, or what the source says of it.
    """
    date = given or date_of(source)
    return SessionInfo(
        source.name,
        source.description,
        len(source),
        config.model_dump(mode="json"),
        versions(),
        start or {},
        date.text,
        date.known_from,
    )
