"""Drives in ROS 1 bags, ROS 2 bags and MCAP files."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from itertools import islice
from pathlib import Path
from typing import Final

import numpy as np
from numpy.typing import NDArray

from recon.core.errors import FormatError, SourceError
from recon.core.values import Rig, StereoPair, check_size
from recon.core.values.arrays import Float64, UInt8
from recon.io.files import resolved
from recon.io.images.image import decode_image
from recon.io.images.ros_image import pixels_of_ros_image
from recon.sources.bag_topics import (
    camera_info_topic,
    choose_topics,
    list_others,
    list_topics,
    names_rectified,
    rig_of_messages,
)
from recon.sources.calibration import CALIBRATE, as_rectified, read_rig
from recon.sources.frame_list import check_most, pair_frames
from recon.sources.one_pair import join_pair
from recon.sources.protocol import Recording
from recon.sources.rosbags import CAMERA_INFO, Bag, BagImage
from recon.sources.settings import SourceSettings
from recon.sources.stamps import check_increasing, pair_stamps, pairs_in_time

BAGS: Final = frozenset({".bag", ".mcap", ".db3"})
_S: Final = 1e-9


@dataclass(frozen=True, eq=False, kw_only=True, repr=False)
class BagSource(Recording):
    """A drive in a bag, which does not say which poses are true; messages are read one at a time.

    Attributes:
        bag: The recording.
        topics: Left and right image topic.
        pairs: Indices of the left and the right message of each pair.
        left_s: float64 (M,), timestamps of all left messages.
        recorded_ns: int64 (M,) and (K,), recording times of the left and right messages.
        stamped: Whether timestamps are those of the headers, not of the recording.
    """

    bag: Bag
    topics: tuple[str, str]
    pairs: Sequence[tuple[int, int]]
    left_s: Float64
    recorded_ns: tuple[NDArray[np.int64], NDArray[np.int64]]
    stamped: bool = True

    @property
    def files(self) -> Sequence[Path]:
        """The calibration file, then those of the recording."""
        inside = (
            sorted(file for file in path.iterdir() if file.is_file()) if path.is_dir() else [path]
            for path in self.bag.paths
        )
        return [*self.texts, *(file for files in inside for file in files)]

    @property
    def stamps_s(self) -> Float64:
        """float64 (N,), times of the left images of the pairs."""
        return self.left_s[[left for left, _ in self.pairs]]

    def frames(self, start: int = 0) -> Iterator[StereoPair]:
        """Read the pairs from number ``start`` on, without reading the messages before."""
        if start >= len(self):
            return
        # One reader per camera, so that pairs with messages far apart need no buffer.
        views = zip(
            *(self._images(side, [pair[side] for pair in self.pairs[start:]]) for side in (0, 1)),
            strict=True,
        )
        for index, (left, right) in enumerate(views, start=start):
            stamp_s = float(self.left_s[self.pairs[index][0]])
            yield join_pair(left, right, stamp_s, index, f"{self.topics[0]}, pair {index}")

    def _images(self, side: int, wanted: Sequence[int]) -> Iterator[UInt8]:
        """Yield the wanted images of one camera, given by their indices in order."""
        times, topic = self.recorded_ns[side], self.topics[side]
        start_ns = int(times[wanted[0]])
        position = int(np.searchsorted(times, start_ns))
        messages = self.bag.images(topic, start_ns)
        for target in wanted:
            message = next(islice(messages, target - position, None), None)
            if message is None:
                raise FormatError(
                    "recording ends early", where=self.bag.paths[0], got=f"{target} of {topic}"
                )
            position = target + 1
            where = f"{self.bag.paths[0]}: {topic}, message {target}"
            image = decode_message(message, where)
            check_size(self.calibration, image.shape[1], image.shape[0], where)
            yield image


def open_bag(path: Path, settings: SourceSettings) -> BagSource:
    """Open a recording, and read all its timestamps to pair the messages."""
    bag = Bag(_find_files(path))
    topics, also = choose_topics(bag, settings)
    times = bag.scan(topics)
    stamps, clock = _stamps(times, topics, path)
    found = pair_stamps(stamps[0], stamps[1], settings.tolerance_s, str(path))
    check_most(len(found.left), min(map(len, stamps)), path)
    pairs, listing = pair_frames(pairs_in_time(stamps, found), settings, path)
    rig, texts, source = _read_rig(bag, topics, pairs[0][0], settings, path)
    also += list_others(bag, topics)
    kind = {".bag": "ROS 1 bag", ".mcap": "MCAP file"}.get(bag.paths[0].suffix, "ROS 2 bag")
    return BagSource(
        name=resolved(path).name,
        description=f"{kind}, {topics[0]} and {topics[1]}, paired by stamps{listing}{clock}, "
        f"{source}{also}",
        calibration=rig,
        bag=bag,
        topics=topics,
        pairs=pairs,
        listing=listing,
        left_s=stamps[0],
        recorded_ns=(times[topics[0]][:, 0], times[topics[1]][:, 0]),
        texts=texts,
        stamped=not clock,
    )


def find_bags(folder: Path) -> list[Path]:
    """Return the recording in a folder: itself, split ROS 1 bags, or the only ROS 2 file."""
    if (folder / "metadata.yaml").is_file():
        return [folder]
    parts = sorted(folder.glob("*.bag"))
    single = [path for path in sorted(folder.iterdir()) if path.suffix in {".mcap", ".db3"}]
    return parts or (single if len(single) == 1 else [])


def decode_message(message: BagImage, where: str) -> UInt8:
    """Decode an image message."""
    if not message.step:
        return decode_image(message.data.tobytes(), where)
    return pixels_of_ros_image(
        message.data,
        message.encoding,
        (message.height_px, message.width_px),
        message.step,
        big_endian=message.big_endian,
        where=where,
    )


def _find_files(path: Path) -> list[Path]:
    if not path.exists():
        raise SourceError("file does not exist", where=path)
    found = [path] if path.is_file() else find_bags(path)
    if not found or (path.is_file() and path.suffix not in BAGS):
        raise SourceError(
            "not a recording",
            where=path,
            expected="a .bag, .mcap or .db3 file, or a ROS 2 folder with metadata.yaml",
        )
    return found


def _stamps(
    times: dict[str, NDArray[np.int64]], topics: tuple[str, str], path: Path
) -> tuple[tuple[Float64, Float64], str]:
    """Return the times of the messages of both cameras; of recording if the headers have none."""
    empty = next((topic for topic in topics if not len(times[topic])), None)
    if empty is not None:
        raise SourceError("topic has no message", where=path, got=empty)
    stamped = all((times[topic][:, 1] != 0).all() for topic in topics)
    left, right = (
        (times[topic][:, 1 if stamped else 0] * _S).astype(np.float64) for topic in topics
    )
    for topic, stamps in zip(topics, (left, right), strict=True):
        check_increasing(stamps, f"{path}: {topic}")
    return (left, right), "" if stamped else ", recording times as the headers have none"


def _read_rig(
    bag: Bag,
    topics: tuple[str, str],
    first: int,
    settings: SourceSettings,
    path: Path,
) -> tuple[Rig, tuple[Path, ...], str]:
    """Return the calibration, the files it was read from, and a note on its origin."""
    infos = [camera_info_topic(bag, topic) for topic in topics]
    if settings.has_camera:
        message = next(islice(bag.images(topics[0]), first, None))
        image = decode_message(message, f"{path}: {topics[0]}")
        rig, texts = read_rig(settings, path, (image.shape[1], image.shape[0]))
        return rig, texts, f"calibration {settings.calibration or 'in numbers'}"
    if None in infos:
        raise SourceError(
            "recording has no calibration of both cameras",
            where=path,
            got=list_topics(bag, (CAMERA_INFO,)) or "no CameraInfo",
            hint=CALIBRATE,
        )
    left, right = (bag.camera_info(topic) for topic in infos if topic is not None)
    rectified = all(map(names_rectified, topics))
    return as_rectified(rig_of_messages(left, right, path, rectified)), (), "its CameraInfo"
