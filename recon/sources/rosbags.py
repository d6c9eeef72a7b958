"""Bags of ROS 1 (.bag), ROS 2 (a folder, .db3) and MCAP, read with rosbags, without ROS.

Only message types that a stereo source or a motion prior needs are read; a bag may contain any
others, known or not. Exceptions of rosbags and its dependencies become a `FormatError`.
"""

from __future__ import annotations

import heapq
import struct
from collections import Counter, defaultdict
from collections.abc import Iterator, Sequence
from contextlib import ExitStack, closing, contextmanager
from itertools import islice
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from recon.core.errors import FormatError, ReconError, SourceError, require
from recon.core.text import counted
from recon.core.values.arrays import Float64
from recon.io.images.packets import BEGINS, codec_of, decode_packets
from recon.io.ros.contents import (
    TRANSFORMS,
    VIDEO,
    VIDEOS,
    BagCameraInfo,
    BagPose,
    camera_info_of,
    imu_row,
    levels_of,
    poses_of,
)
from recon.io.ros.messages import NS_PER_S
from recon.sources.topics import Topic


class Bag:
    """A recording: files of ROS 1 that belong together, or one folder or file of ROS 2."""

    def __init__(self, paths: Sequence[Path]) -> None:
        self.paths = tuple(paths)
        self._ros1 = self.paths[0].suffix == ".bag"
        module = "rosbags.rosbag1" if self._ros1 else "rosbags.rosbag2"
        self._reader = require(module, extra="ros").Reader
        typesys = require("rosbags.typesys", extra="ros")
        store = typesys.Stores.ROS1_NOETIC if self._ros1 else typesys.Stores.ROS2_HUMBLE
        self._store = typesys.get_typestore(store)
        moved = dict.fromkeys(TRANSFORMS, "geometry_msgs/TransformStamped[] transforms\n")
        for kind, fields in (moved | VIDEOS).items():
            if kind not in self._store.types:
                self._store.register(typesys.get_types_from_msg(fields, kind))
        self._codecs = dict[str, str | None]()  # of topics of images; None = no video
        self._begins = defaultdict[str, list[int]](list)  # messages where a video can begin
        self.lost = Counter[str]()  # messages of a video before the first of these
        self.topics = self._find_topics()

    def scan(self, topics: Sequence[str]) -> dict[str, NDArray[np.int64]]:
        """Return of each topic int64 (N, 2), ns: time of recording, in order, and header stamp."""
        times: dict[str, list[tuple[int, int]]] = {topic: [] for topic in topics}
        for topic, recorded_ns, content in self._messages(topics):
            if topic not in self._codecs or self._codecs[topic]:
                self._note(topic, content, len(times[topic]))
            if self._codecs[topic] is None or self._begins[topic]:
                times[topic].append((recorded_ns, self._stamp_ns(content, topic)))
        for topic in (name for name in self.lost if not times[name]):
            got = f"{counted(self.lost[topic], 'message')} of {topic}"
            raise SourceError("video has no keyframe", where=self.paths[0], got=got)
        return {
            topic: np.array(found, dtype=np.int64).reshape(-1, 2) for topic, found in times.items()
        }

    def _note(self, topic: str, content: bytes, number: int) -> None:
        """Note whether a topic is a video, and can be begun with this message, its next."""
        message = self._parse(content, topic)
        form = getattr(message, "format", getattr(message, "encoding", ""))
        if (codec := self._codecs.setdefault(topic, codec_of(form))) is not None:
            if BEGINS[codec].search(message.data.tobytes()):
                self._begins[topic].append(number)
            self.lost[topic] += not self._begins[topic]

    def images(
        self, topic: str, wanted: Sequence[int], recorded_ns: NDArray[np.int64]
    ) -> Iterator[NDArray[Any]]:
        """Decode messages of increasing numbers; ``recorded_ns`` is when all were recorded."""
        codec, first = self._codecs.get(topic), wanted[0]
        if codec is not None:
            first = max(number for number in self._begins[topic] if number <= first)
        start_ns = int(recorded_ns[first])
        position = int(np.searchsorted(recorded_ns, start_ns))
        messages = self._messages([topic], start_ns)
        if codec is not None:
            packets = (self._parse(one[2], topic).data.tobytes() for one in messages)
            where = f"{self.paths[0]}: {topic}"
            yield from decode_packets(enumerate(packets, position), wanted, codec, where)
            return
        for target in wanted:
            found = next(islice(messages, target - position, None), None)
            if found is None:
                got = f"{target} of {topic}"
                raise FormatError("recording ends early", where=self.paths[0], got=got)
            position = target + 1
            where = f"{self.paths[0]}: {topic}, message {target}"
            yield levels_of(self._parse(found[2], topic), where)

    def camera_info(self, topic: str) -> BagCameraInfo:
        for _, _, content in self._messages([topic]):
            return camera_info_of(self._parse(content, topic))
        raise FormatError("topic has no message", where=self.paths[0], got=topic)

    def frame_id(self, topic: str) -> str:
        """Return the coordinate frame that the first image of a topic names; empty if none."""
        for _, _, content in self._messages([topic]):
            message = self._parse(content, topic)
            return str(getattr(message, "header", message).frame_id).lstrip("/")
        return ""

    def poses(self, topic: str) -> Iterator[BagPose]:
        """Yield the poses of a topic of one of the `POSES`, in the order of recording."""
        for _, recorded_ns, content in self._messages([topic]):
            yield from poses_of(self._parse(content, topic), recorded_ns)

    def imu(self, topic: str) -> Float64:
        """Return rows (N, 8): times [ns] of recording and of the header, rates, forces."""
        rows = []
        for _, recorded_ns, content in self._messages([topic]):
            values = imu_row(self._parse(content, topic))
            rows.append([recorded_ns, self._stamp_ns(content, topic), *values])
        return np.array(rows, np.float64).reshape(-1, 8)

    def fixes(self, topic: str) -> Float64:
        """Return rows (N, 9) of positions of a receiver.

        Times [ns] of recording and of the header, status (below 0 = no fix), latitude, longitude,
        height, and standard deviations east, north and up [m]; NaN = unknown.
        """
        rows = []
        for _, recorded_ns, content in self._messages([topic]):
            message = self._parse(content, topic)
            known = message.position_covariance_type > 0
            variance = np.array(message.position_covariance, np.float64)[[0, 4, 8]]
            sigma = np.sqrt(np.where((variance >= 0) & known, variance, np.nan))
            place = message.latitude, message.longitude, message.altitude
            status = message.status.status
            rows.append([recorded_ns, self._stamp_ns(content, topic), status, *place, *sigma])
        return np.array(rows, np.float64).reshape(-1, 9)

    def _find_topics(self) -> dict[str, Topic]:
        found: dict[str, Topic] = {}
        with self._our_errors(), self._opened() as readers:
            for connection in (c for reader in readers for c in reader.connections):
                name, kind = connection.topic, connection.msgtype
                before = found[name].messages or 0 if name in found else 0
                found[name] = Topic(name, kind, before + connection.msgcount)
        return found

    def _messages(
        self, topics: Sequence[str], start_ns: int | None = None
    ) -> Iterator[tuple[str, int, bytes]]:
        """Yield topic, time of recording and content of each message, in that order."""
        with self._our_errors(), self._opened() as readers, ExitStack() as open_streams:
            streams = []
            for reader in readers:
                wanted = [c for c in reader.connections if c.topic in topics]
                if wanted:
                    # A database does not close while rows of it are being read.
                    stream = closing(reader.messages(wanted, start=start_ns))
                    streams.append(open_streams.enter_context(stream))
            for connection, recorded_ns, content in heapq.merge(*streams, key=lambda m: m[1]):
                yield connection.topic, recorded_ns, content

    def _parse(self, content: bytes, topic: str) -> Any:
        kind = self.topics[topic].kind
        with self._our_errors():
            if self._ros1:
                return self._store.deserialize_ros1(content, kind)
            return self._store.deserialize_cdr(content, kind)

    def _stamp_ns(self, content: bytes, topic: str) -> int:
        """Return the header stamp: all supported types begin with a header, or with a stamp."""
        try:
            if self._ros1:  # where a header begins with a number
                at = 0 if self.topics[topic].kind == VIDEO else 4
                seconds, nanoseconds = struct.unpack_from("<II", content, at)
            else:
                # The second byte of CDR gives the byte order.
                order = "<" if content[1] & 1 else ">"
                seconds, nanoseconds = struct.unpack_from(order + "iI", content, 4)
        except (struct.error, IndexError) as error:
            got = f"{counted(len(content), 'byte')} on {topic}"
            raise FormatError("message is too short", where=self.paths[0], got=got) from error
        return int(seconds) * NS_PER_S + int(nanoseconds)

    @contextmanager
    def _opened(self) -> Iterator[list[Any]]:
        with ExitStack() as stack:
            yield [stack.enter_context(self._reader(path)) for path in self.paths]

    @contextmanager
    def _our_errors(self) -> Iterator[None]:
        """Convert any exception that a damaged file causes to a `FormatError`."""
        try:
            yield
        except (ReconError, MemoryError):
            raise
        except Exception as error:
            what, got = "recording cannot be read", str(error) or type(error).__name__
            repair = "repair it with rosbag reindex, ros2 bag reindex or mcap recover"
            hint = f"it may be truncated; copy it again, or {repair}"
            raise FormatError(what, where=self.paths[0], got=got, hint=hint) from error
