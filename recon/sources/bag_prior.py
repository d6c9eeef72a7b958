"""The motion of the rig by other sensors, from a topic of the recording of its images."""

from __future__ import annotations

from collections import defaultdict
from dataclasses import replace
from typing import Final

import numpy as np

from recon.core.errors import FormatError, SourceError
from recon.core.geometry.se3 import invert, make_transform, rotation_from_quaternion
from recon.core.text import counted
from recon.core.values import ImuRecord, Trajectory
from recon.core.values.arrays import Float64
from recon.io.cameras.ros import NS
from recon.io.imu import imu_of
from recon.sources.rosbags import IMU, POSES, TRANSFORMS, Bag, BagPose
from recon.sources.source import ReadPrior

_STATIC: Final = "tf_static"
_ODOMETRY: Final = "odom"  # the frame in which wheels and inertial units measure, by REP 105


def read_topic(bag: Bag, name: str, image_topic: str, *, stamped: bool) -> ReadPrior:
    """Read poses of a topic, as the camera's if static transforms connect them to its images."""
    where = f"{bag.paths[0]}: {name}"
    if name not in bag.topics or bag.topics[name].kind not in POSES:
        what = "recording has no such topic of poses, and there is no such file"
        expected = bag.list_topics(POSES) or "a file; the recording has no poses"
        raise SourceError(what, where=bag.paths[0], got=name, expected=expected)
    (parent, child), poses = _choose_frames(list(bag.poses(name)), where)
    path = _path_of(poses, where, stamped=stamped)
    camera = bag.frame_id(image_topic)
    T_child_camera = _static_transform(bag, child, camera)
    origin = f"{name}, {counted(len(path), 'pose')} of {child or 'an unnamed frame'} in {parent}"
    if T_child_camera is None:
        return ReadPrior(path, f"{origin}, no static transform to {camera or 'the camera'}")
    moved = Trajectory(path.T_world_camera @ T_child_camera, path.timestamps_s)
    return ReadPrior(moved, f"{origin}, moved to {camera} by the static transforms")


def find_imu(bag: Bag) -> str | None:
    """Return the topic of an inertial unit; of several, one of all that it measures."""
    found = [topic for topic in bag.topics.values() if topic.kind == IMU and topic.messages]
    ranked = sorted(found, key=lambda topic: ("accel" in topic.name, "imu" not in topic.name,
                                              -topic.messages, topic.name))  # fmt: skip
    return ranked[0].name if ranked else None


def read_imu_topic(bag: Bag, name: str, image_topic: str, *, stamped: bool) -> ImuRecord:
    """Read an inertial unit, and where static transforms put it beside the camera."""
    table = bag.imu(name)
    where = f"{bag.paths[0]}: {name}"
    columns = [int(stamped), *range(2, 8)]
    places = [f"{name}, message {n}" for n in range(len(table))]
    record = imu_of(table[:, columns], places, where)
    T_imu_camera = _static_transform(bag, bag.frame_id(name), bag.frame_id(image_topic))
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


def _path_of(poses: list[BagPose], where: str, *, stamped: bool) -> Trajectory:
    stamps = [pose.stamp_ns if stamped else pose.recorded_ns for pose in poses]
    times_ns, first = np.unique(stamps, return_index=True)
    for pose in poses:
        norm = float(np.linalg.norm(pose.xyzw))
        if not (np.isfinite(pose.xyz_m).all() and np.isfinite(norm) and norm > 0):
            raise FormatError("pose is not finite, or has no rotation", where=where)
    transforms = [_transform(poses[index]) for index in first]
    return Trajectory(np.stack(transforms), times_ns * NS)


def _transform(pose: BagPose) -> Float64:
    return make_transform(rotation_from_quaternion(pose.xyzw), pose.xyz_m)


def _static_transform(bag: Bag, start: str, goal: str) -> Float64 | None:
    """Return T_start_goal by the static transforms of a recording; None = they do not connect."""
    topics = [t.name for t in bag.topics.values() if t.kind in TRANSFORMS and _STATIC in t.name]
    steps: dict[str, dict[str, Float64]] = defaultdict(dict)
    for pose in (pose for topic in topics for pose in bag.poses(topic)):
        T_parent_child = _transform(pose)
        steps[pose.parent][pose.child] = T_parent_child
        steps[pose.child][pose.parent] = invert(T_parent_child)
    reached, waiting = {start: np.eye(4)}, [start]
    while waiting:
        here = waiting.pop()
        for there, T_here_there in steps[here].items():
            if there not in reached:
                reached[there] = reached[here] @ T_here_there
                waiting.append(there)
    return reached.get(goal) if start and goal else None
