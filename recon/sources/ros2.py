"""Drives that arrive as topics of ROS 2: images and their cameras, and what else guides them."""

from __future__ import annotations

import time
from collections import Counter, deque
from collections.abc import Callable, Iterator
from contextlib import closing, contextmanager
from dataclasses import replace
from functools import partial
from pathlib import Path
from typing import Any, Final, NamedTuple

import numpy as np
from numpy.typing import NDArray

from recon.core.errors import FormatError, ReconError, SettingsError, SourceError
from recon.core.geometry.se3 import invert
from recon.core.progress import LOGGER, stage
from recon.core.text import counted
from recon.core.values import ImuRecord, Recorded, Rig, StereoPair, Trajectory, check_size
from recon.core.values.arrays import Float64, UInt8
from recon.core.values.image import join_pair
from recon.io.cameras.ros import NS
from recon.io.images.image import Levels, eight_bits, find_levels
from recon.io.imu import imu_of
from recon.io.ros.contents import (
    IMU,
    POSES,
    TRANSFORMS,
    VIDEOS,
    BagPose,
    camera_info_of,
    imu_row,
    levels_of,
    poses_of,
    stamp_ns,
)
from recon.io.ros.dds import Network, NetworkTopic, Received
from recon.sources.bag import find_mount, pose_matrix, static_transform
from recon.sources.calibration import read_rig
from recon.sources.settings import SourceSettings
from recon.sources.source import Mount, SourceFigures, StereoSource
from recon.sources.topics import (
    Topic,
    choose_topics,
    find_imu,
    info_topic,
    info_topics,
    rig_of_infos,
)

ADDRESS: Final = "ros2:"
STATIC: Final = "/tf_static"
INITIAL_POSE: Final = "/initialpose"
_WHEELS: Final = tuple(kind for kind in POSES if kind not in TRANSFORMS)  # of one frame each
_WITH_COVARIANCE: Final = "geometry_msgs/msg/PoseWithCovarianceStamped"
_PATIENCE_S: Final = 30.0  # for a driver that starts meanwhile
_QUIET_S: Final = 2.0  # without a pair, after which it is said
_BELIEVED: Final = 3  # images in a row that contradict the time of one before, which is wrong then
_WAITING: Final = 10  # images of a camera that may wait for a partner
_KEPT: Final = 1000  # pairs of which the stamp is known to the nanosecond
_CLIPPED: Final = 0.01  # fraction of a 16-bit image that may be beyond black and white
_FAST: Final = 2000  # messages of an inertial unit or of wheels that are kept: some seconds


class _Image(NamedTuple):
    """An image that waits for its partner; it is decoded when it has one."""

    stamp_ns: int
    message: Any
    arrived_s: float


class Ros2Source(StereoSource):
    """The pairs that arrive on two topics, for as long as a network is open."""

    live = True
    name: str
    calibration: Rig
    description: str

    def __init__(
        self,
        network: Network,
        images: tuple[str, str],
        settings: SourceSettings,
        stopped: Callable[[], bool] = lambda: False,
    ) -> None:
        self.network, self.images, self._settings = network, images, settings
        self.name = f"{ADDRESS}{','.join(images)}"
        self._stopped = stopped
        self._waiting = {topic: deque[_Image](maxlen=_WAITING) for topic in images}
        self._last_ns, self._back = dict.fromkeys(images, 0), dict.fromkeys(images, 0)
        self._alone = self._paired_ns = 0
        self._counting = False  # images without a partner: not where a drive begins
        self._refused = Counter[tuple[str, str]]()
        self._sent = dict[float, tuple[int, float]]()  # stamp and arrival of the last pairs
        self._frames = dict[str, str]()  # the coordinate frame that each topic names
        self.latest = dict[str, Any]()  # the last message of each other topic
        self._mounted = dict[tuple[str, str], BagPose]()  # the last of each static transform
        self._rates = dict[str, deque[list[float]]]()  # ns, rates of turn, forces, of each unit
        self._start: Float64 | None = None
        self._levels: Levels | None = None  # of 16-bit images
        self._wheels = deque[tuple[int, str, Float64]](maxlen=_FAST)

    def __len__(self) -> int:
        """Return the largest number of pairs; 0 = not known."""
        return self._settings.end or 0

    def frames(self, start: int = 0) -> Iterator[StereoPair]:
        """Yield the pairs from now on, numbered from 0; the first ``start`` are left out."""
        index = 0
        next(self._messages(), None)  # what has waited since the network was last read is old
        for waiting in self._waiting.values():
            waiting.clear()
        self._counting = False
        for left, right in self._matching():
            if index == self._settings.end:
                return
            with self._refusing():
                images = self._eight_bits(self._decoded(0, left), self._decoded(1, right))
                pair = join_pair(*images, left.stamp_ns * NS, index, f"pair {index}")
                arrived_s = max(left.arrived_s, right.arrived_s)
                self._sent[pair.timestamp_s] = left.stamp_ns, arrived_s
                if len(self._sent) > _KEPT:
                    del self._sent[next(iter(self._sent))]
                index += 1
                if pair.index >= start:
                    yield pair

    def due_s(self, pair: Recorded) -> float:
        """Return when a pair was whole, by `time.monotonic`."""
        return self._sent[pair.timestamp_s][1]

    def stamp_ns(self, timestamp_s: float) -> int:
        """Return the stamp of a pair as it was sent: seconds in 64 bits are off by up to 120 ns."""
        known = self._sent.get(timestamp_s)
        return round(timestamp_s / NS) if known is None else known[0]

    def read_mount(self) -> Mount | None:
        return find_mount([*self._mounted.values()], self._frames.get(self.images[0], ""))

    def read_imu(self) -> ImuRecord | None:
        for topic, newest in self._rates.items():
            rows = list(newest)  # others are added meanwhile
            names = [f"{topic}, message {n}" for n in range(len(rows))]
            with self._refusing():
                record = imu_of(np.array(rows), names, topic)
                T_imu_camera = self._to_camera(self._frames[topic])
                if T_imu_camera is None:
                    return record
                return replace(record, T_camera_imu=invert(T_imu_camera))
        return None

    def recent_path(self) -> Trajectory | None:
        poses = list(self._wheels)  # others are added meanwhile
        if not poses:
            return None
        child, T_child_camera = poses[-1][1], None
        with self._refusing():
            T_child_camera = self._to_camera(child)
        if T_child_camera is None:
            what, got = "no static transform leads to the camera", child or "an unnamed frame"
            self._refuse(FormatError(what, where="odometry of the wheels", got=got))
            return None
        times_ns, first = np.unique([one[0] for one in poses], return_index=True)
        T = np.stack([poses[k][2] for k in first.tolist()])
        return Trajectory(T @ T_child_camera, times_ns * NS)

    def asked_start(self) -> Float64 | None:
        """Return ``T_map_base`` (4, 4) that was sent since the last call, as RViz does."""
        start, self._start = self._start, None
        return start

    def _to_camera(self, frame: str) -> Float64 | None:
        """Return the pose (4, 4) of the left camera in a frame, by the static transforms."""
        return static_transform(
            [*self._mounted.values()], frame, self._frames.get(self.images[0], "")
        )

    def between(self) -> Float64 | None:
        """Wait until a static transform connects both cameras; return ``T_right_left`` (4, 4)."""
        find = partial(self._to_camera, self._frames.get(self.images[1], ""))
        what = "a baseline: in P of a CameraInfo, or as a static transform between both cameras"
        self.wait_for(what, lambda: find() is not None)
        return find()

    def warnings(self) -> list[str]:
        out = f"{counted(self._alone, 'image')} without a partner: left out"
        refused = [
            f"{topic}: {counted(count, 'message')} not used: {what}"
            for (topic, what), count in self._refused.items()
        ]
        return [out, *refused] if self._alone else refused

    def figures(self) -> SourceFigures:
        return SourceFigures(frames_left_out=self._alone)

    def wait_for(self, what: str, known: Callable[[], bool]) -> None:
        """Take messages until something is known; `SourceError` if it takes too long."""
        stage(f"wait for {what}")
        end_s = time.monotonic() + _PATIENCE_S
        for _ in self._messages():
            if known():
                return
            if time.monotonic() > end_s:
                break
        if self._stopped():
            raise SourceError(f"stopped while waiting for {what}", where=self.name)
        counts = ", ".join(
            f"{topic}: {counted(one.publishers, 'publisher')}"
            for topic, one in sorted(self.network.topics().items())
        )
        raise SourceError(
            f"no message with {what} came in {_PATIENCE_S:.0f} s",
            where=self.name,
            got=counts or "no topic at all",
            hint=f"domain {self.network.domain} was listened to, on {self.network.reach}",
        )

    def first_images(self) -> tuple[NDArray[Any], NDArray[Any]]:
        """Return the first image of each camera, of whatever size; they may be of two moments."""
        sides = dict[str, NDArray[Any]]()

        def decoded() -> bool:
            for topic, waiting in self._waiting.items():
                with self._refusing():
                    if waiting:
                        sides[topic] = levels_of(waiting.pop().message, topic)
            return len(sides) == len(self.images)

        self.wait_for("images", decoded)
        left, right = (sides[topic] for topic in self.images)
        return left, right

    def _matching(self) -> Iterator[tuple[_Image, _Image]]:
        """Yield images that belong together: each is the nearest of the other camera."""
        tolerance_ns = round(self._settings.tolerance_s / NS)
        left, right = (self._waiting[topic] for topic in self.images)
        paired_s, quiet_s, apart_ns = time.monotonic(), _QUIET_S, 0
        for _ in self._messages():
            while left and right:
                late_ns = right[0].stamp_ns - left[0].stamp_ns
                earlier, later = (left, right) if late_ns > 0 else (right, left)
                nearer = len(earlier) > 1 and abs(earlier[1].stamp_ns - later[0].stamp_ns) < abs(
                    late_ns
                )
                if abs(late_ns) > tolerance_ns or nearer:
                    earlier.popleft()
                    apart_ns = min(apart_ns or abs(late_ns), abs(late_ns))
                    self._alone += self._counting
                    continue
                self._counting, apart_ns = True, 0
                paired_s, self._paired_ns = time.monotonic(), left[0].stamp_ns
                yield left.popleft(), right.popleft()
            if time.monotonic() - paired_s > quiet_s:
                waiting = ", ".join(f"{len(self._waiting[one])} of {one}" for one in self.images)
                apart = (
                    f"; stamps are {apart_ns * NS:.3f} s apart (--tolerance)" if apart_ns else ""
                )
                LOGGER.warning(
                    "no pair for %.0f s; images that wait: %s%s", quiet_s, waiting, apart
                )
                quiet_s *= 2  # who is told each time reads none of it

    def _messages(self) -> Iterator[None]:
        """Take what arrives, until the drive is stopped."""
        for messages in self.network.receive(self._stopped):
            for one in messages:
                with self._refusing():
                    self._take(one)
            yield

    def _take(self, one: Received) -> None:
        message = one.parse()
        if hasattr(message, "header"):
            self._frames[one.topic] = str(message.header.frame_id).lstrip("/")
        if one.topic in self._waiting:
            self._check_time(one.topic, stamp_ns(message))
            self._alone += self._counting and len(self._waiting[one.topic]) == _WAITING
            self._waiting[one.topic].append(_Image(stamp_ns(message), message, one.arrived_s))
        elif one.topic == STATIC:
            self._mounted |= {(edge.parent, edge.child): edge for edge in poses_of(message, 0)}
        elif one.kind == IMU:
            rows = self._rates.setdefault(one.topic, deque(maxlen=_FAST))
            rows.append([stamp_ns(message), *imu_row(message)])
        elif one.kind in POSES:
            poses = [(p.stamp_ns, p.child, pose_matrix(p, one.topic)) for p in poses_of(message, 0)]
            if one.topic == INITIAL_POSE:
                self._start = poses[0][-1]
            else:
                self._wheels += poses
        else:
            self.latest[one.topic] = message

    def _check_time(self, topic: str, at_ns: int) -> None:
        """Refuse an image whose time is not after those before; or those, if several say so."""
        if at_ns <= 0:
            raise FormatError("image has no time in its header", where=topic)
        before_ns = self._last_ns[topic]
        self._back[topic] = self._back[topic] + 1 if at_ns <= before_ns else 0
        if self._back[topic] in range(1, _BELIEVED) or at_ns <= self._paired_ns:
            what, got = "image is not later than the one before", (at_ns - before_ns) * NS
            raise FormatError(what, where=topic, got=f"{got:.3f} s")
        if self._back[topic]:
            self._waiting[topic].clear()
        self._last_ns[topic] = at_ns

    def _decoded(self, side: int, one: _Image) -> NDArray[Any]:
        image = levels_of(one.message, self.images[side])
        check_size(self.calibration, image.shape[1], image.shape[0], self.images[side])
        return image

    def _eight_bits(self, left: NDArray[Any], right: NDArray[Any]) -> tuple[UInt8, UInt8]:
        """Scale 16 bits by the first pair, and by more where much of a later one is beyond it."""
        known, deep = self._levels, [one for one in (left, right) if one.dtype != np.uint8]
        if known is None or any((np.clip(one, *known) != one).mean() > _CLIPPED for one in deep):
            found = find_levels(deep)
            if known is not None:
                found = Levels(min(found.black, known.black), max(found.white, known.white))
                LOGGER.warning("16-bit images: %d is black from now on, %d white", *found)
            self._levels = known = found
        return eight_bits(left, known), eight_bits(right, known)

    @contextmanager
    def _refusing(self) -> Iterator[None]:
        try:
            yield
        except ReconError as error:
            self._refuse(error)

    def _refuse(self, error: ReconError) -> None:
        """Say once of each fault of a topic that its messages are not used, and count them."""
        fault = str(error.where), error.what
        if fault not in self._refused:
            LOGGER.warning("%s; not used", error)
        self._refused[fault] += 1


@contextmanager
def open_ros2(
    address: str,
    settings: SourceSettings,
    prior: str | None = None,
    stopped: Callable[[], bool] = lambda: False,
) -> Iterator[Ros2Source]:
    """Join a network of ROS 2, for the body of a ``with`` statement, and find the cameras in it.

    Args:
        address: ``ros2:``, alone or with the topics of the left, or left and right images.
        settings: How pairs are found; ``end`` is the number of pairs.
        prior: Topic of the odometry of the wheels; None = none.
        stopped: Asked now and then; True ends the drive.

    Raises:
        SourceError: Nobody publishes the images, or what calibrates them, within 30 seconds.
        CalibrationError: The calibration cannot give depth.
        SettingsError: The environment names no possible domain.
        MissingDependencyError: The extra ``ros2`` is not installed.
    """
    names = [name for name in address.removeprefix(ADDRESS).split(",") if name]
    if (
        len(names) > 2
        or len({*names}) < len(names)
        or not all(one.startswith("/") for one in names)
    ):
        what, expected = "not topics of two cameras", f"such as {ADDRESS}/left/image_raw"
        raise SettingsError(what, where=address, expected=expected)
    if settings.shift_frames:
        what = "images on a network are paired by their stamps"
        raise SettingsError(
            what, where="source.shift_frames", got=settings.shift_frames, expected=0
        )
    named = dict(zip(("left", "right"), names, strict=False))
    settings = settings.model_copy(update=named)
    with closing(Network()) as network:
        images, also, topics = _find_cameras(network, settings, address.rstrip(":"), stopped)
        source = Ros2Source(network, images, settings, stopped)
        _listen(source, network, topics, prior)
        sizes = [image.shape[:2] for image in source.first_images()]
        size, note = (sizes[0][1], sizes[0][0]), ""
        if settings.has_camera:
            rig, source.files = read_rig(settings, Path(), size)
            known = f"calibration {settings.calibration or 'in numbers'}"
        else:
            infos = info_topics(topics, images, source.name)
            source.wait_for("CameraInfo", lambda: all(one in source.latest for one in infos))
            left, right = (camera_info_of(source.latest[one]) for one in infos)
            rig, note = rig_of_infos(left, right, images, source.name, size, source.between)
            known = "their CameraInfo" + (f" ({note})" if note else "")
        source.calibration = rig
        source.description = (
            f"topics of ROS 2, domain {network.domain}, {network.reach}; paired by stamps, "
            f"{known}{also}"
        )
        yield source


def _find_cameras(
    network: Network, settings: SourceSettings, where: str, stopped: Callable[[], bool]
) -> tuple[tuple[str, str], str, dict[str, Topic]]:
    """Wait until somebody publishes two image topics; return them, a note, and all topics."""
    stage(f"look for cameras in domain {network.domain}, on {network.reach}")
    end_s, before = time.monotonic() + _PATIENCE_S, -1
    while True:
        known = [one for one in network.topics().values() if one.kind not in VIDEOS]
        topics = {one.name: Topic(one.name, one.kind) for one in known}
        settled, before = len(topics) == before, len(topics)
        try:
            images, also = choose_topics(topics, settings, where)
            if settled:  # else the calibration, or a better pair, may be about to be found
                return images, also, topics
        except SourceError as error:
            if time.monotonic() > end_s or stopped():
                listened = f"domain {network.domain} was listened to, on {network.reach}"
                got = error.got if topics else "no topic at all"
                raise SourceError(error.what, where=where, got=got, expected=error.expected,
                                  hint=listened) from error  # fmt: skip
        time.sleep(0.5)


def _listen(
    source: Ros2Source, network: Network, topics: dict[str, Topic], prior: str | None
) -> None:
    """Subscribe to the images of a source, and to what is beside them."""
    offered = network.topics()
    infos = (info_topic(topics, image) for image in source.images)
    imu = find_imu(topics)
    wanted = [*source.images, *(one for one in (*infos, imu) if one is not None)]
    if prior is not None:
        if prior not in topics or topics[prior].kind not in _WHEELS:
            got = ", ".join(name for name, one in topics.items() if one.kind in _WHEELS)
            what = "nobody publishes poses on this topic"
            raise SourceError(what, where=prior, got=f"poses on {got}" if got else "no poses")
        wanted.append(prior)
    for name in dict.fromkeys(wanted):
        network.subscribe(offered[name], _FAST if name in (imu, prior) else _WAITING)
    # Of others that may come later: of RViz, and of the description of the robot.
    network.subscribe(NetworkTopic(INITIAL_POSE, _WITH_COVARIANCE))
    network.subscribe(offered.get(STATIC, NetworkTopic(STATIC, TRANSFORMS[0], True, True)))
