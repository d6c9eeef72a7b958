"""Drives in ROS 1 bags, ROS 2 bags and MCAP files, with what other sensors recorded beside."""

from __future__ import annotations

from collections import defaultdict, deque
from collections.abc import Iterable, Iterator, Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from pathlib import Path
from typing import Final

import numpy as np
from numpy.typing import NDArray

from recon.core.errors import FormatError, SourceError
from recon.core.geometry.se3 import invert, make_transform, rotation_from_quaternion
from recon.core.text import counted
from recon.core.values import ImuRecord, StereoPair, Trajectory, check_size
from recon.core.values.arrays import Float64, UInt8
from recon.core.values.image import join_pair
from recon.io.cameras.ros import NS
from recon.io.files import reading, refuse_special, resolved
from recon.io.images.image import Levels, eight_bits, find_levels
from recon.io.imu import imu_of
from recon.io.positions import Positions, in_order, read_positions
from recon.io.ros.contents import CAMERA_INFO, FIX, POSES, TRANSFORMS, BagPose
from recon.sources.calibration import read_rig
from recon.sources.images import find_partners, sample_of
from recon.sources.rosbags import Bag
from recon.sources.settings import SourceSettings
from recon.sources.source import BASES, Mount, ReadPrior, Recording, pair_frames
from recon.sources.times import check_increasing, pair_stamps
from recon.sources.topics import (
    IMAGES,
    choose_topics,
    find_imu,
    info_topics,
    list_topics,
    rig_of_infos,
)

BAGS: Final = frozenset({".bag", ".mcap", ".db3"})
_LISTED: Final = 20  # most topics in a description


@dataclass(frozen=True, eq=False, kw_only=True, repr=False)
class BagSource(Recording):
    """A drive in a bag; messages are read one at a time."""

    bag: Bag
    topics: tuple[str, str]
    pairs: Sequence[tuple[int, int]]
    left_s: Float64
    recorded_ns: tuple[NDArray[np.int64], NDArray[np.int64]]
    stamped: bool = True

    @cached_property
    def files(self) -> Sequence[Path]:
        inside = (
            sorted(file for file in path.iterdir() if file.is_file()) if path.is_dir() else [path]
            for path in self.bag.paths
        )
        return [*self.texts, *(file for files in inside for file in files)]

    @cached_property
    def stamps_s(self) -> Float64:
        return self.left_s[[left for left, _ in self.pairs]]

    def read_prior(self, name: str) -> ReadPrior:
        if Path(name).is_file():
            return super().read_prior(name)
        return read_topic(self.bag, name, self.topics[0], stamped=self.stamped)

    def read_imu(self) -> ImuRecord | None:
        name = find_imu(self.bag.topics)
        if name is None:
            return None
        return read_imu_topic(self.bag, name, self.topics[0], stamped=self.stamped)

    def read_mount(self) -> Mount | None:
        with reading(self.bag.paths[0]):
            return find_mount(_static_edges(self.bag), self.bag.frame_id(self.topics[0]))

    @cached_property
    def levels(self) -> Levels:
        """What becomes black and white in all images of 16 bits; from a sample of both cameras."""
        places = [(side, self.pairs[k][side]) for k in sample_of(len(self)) for side in (0, 1)]
        return find_levels(
            next(self.bag.images(self.topics[side], [number], self.recorded_ns[side]))
            for side, number in places
        )

    def frames(self, start: int = 0) -> Iterator[StereoPair]:
        if start >= len(self):
            return
        # One reader per camera, so that pairs with messages far apart need no buffer.
        pairs = self.pairs[start:]
        sides = (self._images(side, [pair[side] for pair in pairs]) for side in (0, 1))
        for index, (left, right) in enumerate(zip(*sides, strict=True), start=start):
            stamp_s = float(self.left_s[self.pairs[index][0]])
            yield join_pair(left, right, stamp_s, index, f"{self.topics[0]}, pair {index}")

    def _images(self, side: int, wanted: Sequence[int]) -> Iterator[UInt8]:
        images = self.bag.images(self.topics[side], wanted, self.recorded_ns[side])
        for target, image in zip(wanted, images, strict=True):
            where = f"{self.bag.paths[0]}: {self.topics[side]}, message {target}"
            check_size(self.calibration, image.shape[1], image.shape[0], where)
            yield image if image.dtype == np.uint8 else eight_bits(image, self.levels)


def open_bag(path: Path, settings: SourceSettings) -> BagSource:
    """Open a recording, and read all its timestamps to pair the messages."""
    bag = Bag(recording_files(path))
    topics, also = choose_topics(bag.topics, settings, bag.paths[0])
    times = bag.scan(topics)
    stamps, clock = _stamps(times, topics, path)
    frames = pair_stamps(stamps[0], stamps[1], settings.tolerance_s, path)
    pairs, listing = pair_frames(frames, settings, path)
    recorded_ns = (times[topics[0]][:, 0], times[topics[1]][:, 0])
    first = next(bag.images(topics[0], [pairs[0][0]], recorded_ns[0]))
    size, note, texts = (first.shape[1], first.shape[0]), "", tuple[Path, ...]()
    if settings.has_camera:
        rig, texts = read_rig(settings, path, size)
        source = f"calibration {settings.calibration or 'in numbers'}"
    else:
        left, right = [bag.camera_info(name) for name in info_topics(bag.topics, topics, path)]
        rig, note = rig_of_infos(left, right, topics, path, size, lambda: static_transform(
            _static_edges(bag), bag.frame_id(topics[1]), bag.frame_id(topics[0])))  # fmt: skip
        source = "its CameraInfo" + (f" ({note})" if note else "")
    also += _list_others(bag, topics)
    lost = [f"{name}: {counted(count, 'image')} before the first keyframe of the video: left out"
            for name, count in bag.lost.items() if count]  # fmt: skip
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
        recorded_ns=recorded_ns,
        texts=texts,
        stamped=not clock,
        notes=(*([note] if note else []), *lost),
    )


def find_bags(folder: Path) -> list[Path]:
    """Return the recording in a folder: itself, split ROS 1 bags, or the only ROS 2 file."""
    if (folder / "metadata.yaml").is_file():
        return [folder]
    parts = sorted(folder.glob("*.bag"))
    single = [path for path in sorted(folder.iterdir()) if path.suffix in {".mcap", ".db3"}]
    return parts or (single if len(single) == 1 else [])


def recording_files(path: Path) -> list[Path]:
    """Return the files of a recording, or a folder of ROS 2; `SourceError` if it is none."""
    if not path.exists():
        raise SourceError("file does not exist", where=path)
    found = [path] if path.is_file() else find_bags(path)
    if not found or (path.is_file() and path.suffix not in BAGS):
        expected = "a .bag, .mcap or .db3 file, or a ROS 2 folder with metadata.yaml"
        raise SourceError("not a recording", where=path, expected=expected)
    for each in found:
        for file in each.iterdir() if each.is_dir() else [each]:
            refuse_special(file)
    return found


def _stamps(
    times: dict[str, NDArray[np.int64]], topics: tuple[str, str], path: Path
) -> tuple[tuple[Float64, Float64], str]:
    """Return the times of the messages of both cameras; of recording if the headers have none."""
    for topic in topics:
        if not len(times[topic]):
            raise SourceError("topic has no message", where=path, got=topic)
    stamped = all((times[topic][:, 1] != 0).all() for topic in topics)
    left, right = ((times[topic][:, int(stamped)] * NS).astype(np.float64) for topic in topics)
    for topic, stamps in zip(topics, (left, right), strict=True):
        check_increasing(stamps, f"{path}: {topic}")
    return (left, right), "" if stamped else ", recording times as the headers have none"


def _list_others(bag: Bag, used: Sequence[str]) -> str:
    """Return a note on other topics than those of images, and on which `--prior` takes."""
    images = [name for name, topic in bag.topics.items() if topic.kind in IMAGES]
    named = {
        *used,
        find_imu(bag.topics),
        *(name for pair in find_partners(images) for name in pair),
    }
    unused = {name for name, topic in bag.topics.items() if topic.kind != CAMERA_INFO} - named
    others = sorted(unused)
    if not others:
        return ""
    poses = [name for name in others if bag.topics[name].kind in POSES and "static" not in name]
    listed = ", ".join(others[:_LISTED]) + (" …" if len(others) > _LISTED else "")
    return f", other topics: {listed}" + (f" (for --prior: {', '.join(poses)})" if poses else "")


_STATIC: Final = "tf_static"
_UNIT: Final = 1e-2  # off length 1, from which tf2 ignores a quaternion
_ODOMETRY: Final = "odom"  # the frame in which wheels and inertial units measure, by REP 105


def read_topic(bag: Bag, name: str, image_topic: str, *, stamped: bool) -> ReadPrior:
    """Read poses of a topic, as the camera's if static transforms connect them to its images."""
    where = f"{bag.paths[0]}: {name}"
    if name not in bag.topics or bag.topics[name].kind not in POSES:
        what = "recording has no such topic of poses, and there is no such file"
        expected = list_topics(bag.topics, POSES) or "a file; the recording has no poses"
        raise SourceError(what, where=bag.paths[0], got=name, expected=expected)
    (parent, child), poses = _choose_frames(list(bag.poses(name)), where)
    stamps = [pose.stamp_ns if stamped else pose.recorded_ns for pose in poses]
    times_ns, first = np.unique(stamps, return_index=True)
    path = Trajectory(np.stack([pose_matrix(pose, where) for pose in poses])[first], times_ns * NS)
    camera = bag.frame_id(image_topic)
    with reading(bag.paths[0]):
        T_child_camera = static_transform(_static_edges(bag), child, camera)
    origin = f"{name}, {counted(len(path), 'pose')} of {child or 'an unnamed frame'} in {parent}"
    if T_child_camera is None:
        return ReadPrior(path, f"{origin}, no static transform to {camera or 'the camera'}")
    moved = Trajectory(path.T_world_camera @ T_child_camera, path.timestamps_s)
    return ReadPrior(moved, f"{origin}, moved to {camera} by the static transforms")


def read_imu_topic(bag: Bag, name: str, image_topic: str, *, stamped: bool) -> ImuRecord:
    """Read an inertial unit, and where static transforms put it beside the camera."""
    table = bag.imu(name)
    where = f"{bag.paths[0]}: {name}"
    columns = [int(stamped), *range(2, 8)]
    places = [f"{name}, message {n}" for n in range(len(table))]
    record = imu_of(table[:, columns], places, where)
    with reading(bag.paths[0]):
        names = bag.frame_id(name), bag.frame_id(image_topic)
        T_imu_camera = static_transform(_static_edges(bag), *names)
    if T_imu_camera is not None:
        return replace(record, T_camera_imu=invert(T_imu_camera))
    note = f"IMU: no static transform from {name} to the camera: its axes are what the drive shows"
    return replace(record, notes=(*record.notes, note))


def _choose_frames(poses: list[BagPose], where: str) -> tuple[tuple[str, str], list[BagPose]]:
    """Return the poses of one frame in another: the only ones, or those in the odometry frame."""
    found: dict[tuple[str, str], list[BagPose]] = defaultdict(list)
    for pose in poses:
        found[pose.parent, pose.child].append(pose)
    if not found:
        raise SourceError("topic has no message", where=where)
    chosen = list(found) if len(found) == 1 else [names for names in found if names[0] == _ODOMETRY]
    if len(chosen) != 1:
        what = "topic has poses of several frames"
        got = ", ".join(f"{child} in {parent}" for parent, child in list(found)[:8])
        expected, hint = "one, or one in the frame odom", "name a topic of odometry or poses"
        raise SourceError(what, where=where, got=got, expected=expected, hint=hint)
    return chosen[0], found[chosen[0]]


def pose_matrix(pose: BagPose, where: str) -> Float64:
    """Return a pose as float64 (4, 4); `FormatError` if it is none."""
    norm = float(np.linalg.norm(pose.xyzw))
    if not (np.isfinite(pose.xyz_m).all() and np.isfinite(norm) and norm > 0):
        raise FormatError("pose is not finite, or has no rotation", where=where)
    return _transform(pose)


def _transform(pose: BagPose) -> Float64:
    return make_transform(rotation_from_quaternion(pose.xyzw), pose.xyz_m)


def static_transform(edges: Iterable[BagPose], start: str, goal: str) -> Float64 | None:
    """Return T_start_goal, float64 (4, 4), by static transforms; None = they do not connect.

    The way has as few steps as can be. Of what is said of two frames the last counts, and what is
    no motion does not, as in tf; where nothing else leads to the goal, it is a `FormatError`.
    """
    steps: dict[str, dict[str, Float64]] = defaultdict(dict)
    broken = []
    for edge in edges:
        unit = abs(float(np.linalg.norm(edge.xyzw)) - 1.0) <= _UNIT
        if not (unit and np.isfinite(edge.xyz_m).all()):
            broken.append(f"{edge.parent} to {edge.child}, {edge.xyz_m}, {edge.xyzw}")
            continue
        steps[edge.parent][edge.child] = _transform(edge)
        steps[edge.child][edge.parent] = invert(_transform(edge))
    start, goal = start.lstrip("/"), goal.lstrip("/")
    reached, waiting = {start: np.eye(4)}, deque([start])
    while waiting:
        here = waiting.popleft()
        for there, T_here_there in steps[here].items():
            if there not in reached:
                reached[there] = reached[here] @ T_here_there
                waiting.append(there)
    if goal and goal not in reached and broken:
        what, expected = "a static transform is no motion", "a quaternion of length 1"
        raise FormatError(what, got=broken[0], expected=f"finite numbers, {expected}")
    return reached.get(goal) if start and goal else None


def find_mount(edges: Iterable[BagPose], camera: str) -> Mount | None:
    """Return where the frame of the left images is on a robot; None = nothing connects them.

    Its base is ``base_footprint``, on the ground, or else ``base_link``, with any prefix that ends
    in a slash. Errors are those of `static_transform`.
    """
    known, camera = list(edges), camera.lstrip("/")
    names = sorted({name for edge in known for name in (edge.parent, edge.child)} - {camera})
    for base in (name for last in BASES for name in names if name.rpartition("/")[2] == last):
        if (T_base_camera := static_transform(known, base, camera)) is not None:
            found, root = Mount(T_base_camera, base, camera), _root_above(base, known)
            T_base_root = static_transform(known, base, root)
            return (
                found if T_base_root is None else replace(found, root=root, T_base_root=T_base_root)
            )
    return None


def _root_above(base: str, edges: Sequence[BagPose]) -> str:
    """Return the frame that has a base below it and no parent; "" = the base itself."""
    parents = {edge.child: edge.parent for edge in edges}
    way = [base]
    while (parent := parents.get(way[-1])) is not None and parent not in way:
        way.append(parent)
    return "" if len(way) == 1 else way[-1]


def _static_edges(bag: Bag) -> list[BagPose]:
    topics = [t.name for t in bag.topics.values() if t.kind in TRANSFORMS and _STATIC in t.name]
    return [pose for topic in topics for pose in bag.poses(topic)]


def read_measured(path: Path) -> Positions:
    """Read positions of a recording, ``BAG`` or ``BAG:/TOPIC``, or of a file (`read_positions`).

    Messages without a fix are left out; times are those of the headers, of recording where these
    have none. What is missing, damaged or not named of several receivers is a `ReconError`.

    Ref: ROS, ``sensor_msgs/NavSatFix``; heights are above the ellipsoid of WGS 84.
    """
    name, _, topic = str(path).partition(":/")
    place = Path(name)
    if place.suffix not in BAGS and not (place.is_dir() and find_bags(place)):
        return read_positions(path)
    bag = Bag(recording_files(place))
    known = [one.name for one in bag.topics.values() if one.kind == FIX and one.messages]
    chosen = [f"/{topic}"] if topic else known
    if len(chosen) != 1 or chosen[0] not in known:
        what = "several receivers" if len(chosen) > 1 else "no positions of a receiver"
        none = f"no NavSatFix among {', '.join(bag.topics) or 'none'}"
        got = list_topics(bag.topics, (FIX,)) or none
        hint = f"name one: {place}:{known[0]}" if known else None
        raise SourceError(f"the recording has {what}", where=path, got=got, hint=hint)
    table = bag.fixes(chosen[0])
    times_ns = np.where((table[:, 1] > 0).all(), table[:, 1], table[:, 0])
    fixed = table[:, 2] >= 0
    positions = Positions(
        times_s=np.where(fixed, times_ns * NS, np.nan),
        places=table[:, 3:6],
        sigma_m=table[:, 6:],
        degrees=True,
        heights="the ellipsoid",
    )
    return in_order(positions, path)
