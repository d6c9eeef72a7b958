"""Writes bags of a drive as recorders do, optionally damaged."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import cv2
import numpy as np
from rosbags.rosbag1 import Writer as Writer1
from rosbags.rosbag2 import StoragePlugin
from rosbags.rosbag2 import Writer as Writer2
from rosbags.typesys import Stores, get_types_from_msg, get_typestore

from recon.core.geometry.se3 import quaternion_from_rotation
from recon.core.values import RectifiedCamera, StereoPair
from tests.sources.drives import EPOCH_S, Writer, projections

TOPICS = ("/stereo/left/image_rect", "/stereo/right/image_rect")


@dataclass(frozen=True)
class Recording:
    """How a bag is written.

    ``kind`` is ros1, ros2 or mcap; ``compressed`` writes PNG messages; ``info`` writes CameraInfo.
    """

    kind: str
    topics: tuple[str, str] = TOPICS
    compressed: bool = False
    info: bool = True
    stamped: bool = True
    encoding: str = "mono8"
    odometry: np.ndarray | None = None
    """T_odom_base of each pair, (N, 4, 4), on ``/odom``."""

    @property
    def name(self) -> str:
        return {"ros1": "drive.bag", "ros2": "drive", "mcap": "drive"}[self.kind]


class Recorder:
    """Writes messages of one bag."""

    def __init__(self, writer: Any, how: Recording) -> None:
        self.writer, self.how = writer, how
        self.ros1 = how.kind == "ros1"
        self.store = get_typestore(Stores.ROS1_NOETIC if self.ros1 else Stores.ROS2_HUMBLE)
        if self.ros1:
            text = "geometry_msgs/TransformStamped[] transforms"
            self.store.register(get_types_from_msg(text, "tf2_msgs/msg/TFMessage"))
        self.connections: dict[str, Any] = {}

    def write(self, topic: str, recorded_ns: int, message: Any) -> None:
        kind = message.__msgtype__
        if topic not in self.connections:
            self.connections[topic] = self.writer.add_connection(topic, kind, typestore=self.store)
        pack = self.store.serialize_ros1 if self.ros1 else self.store.serialize_cdr
        self.writer.write(self.connections[topic], recorded_ns, pack(message, kind))

    def header(self, stamp_ns: int, frame_id: str = "cam") -> Any:
        types = self.store.types
        time = types["builtin_interfaces/msg/Time"](sec=stamp_ns // 10**9, nanosec=stamp_ns % 10**9)
        extra = {"seq": 0} if self.ros1 else {}
        return types["std_msgs/msg/Header"](stamp=time, frame_id=frame_id, **extra)

    def image(self, stamp_ns: int, image: np.ndarray) -> Any:
        types, header = self.store.types, self.header(stamp_ns if self.how.stamped else 0)
        if self.how.compressed:
            data = cv2.imencode(".png", image)[1].ravel()
            return types["sensor_msgs/msg/CompressedImage"](
                header=header, format="mono8; png compressed", data=data
            )
        height, width = image.shape[:2]
        padded = np.zeros((height, image[0].size + 3), np.uint8)  # rows end in padding
        padded[:, :-3] = image.reshape(height, -1)
        return types["sensor_msgs/msg/Image"](
            header=header, height=height, width=width, encoding=self.how.encoding,
            is_bigendian=0, step=padded.shape[1], data=padded.ravel(),
        )  # fmt: skip

    def odometry(self, stamp_ns: int, T: np.ndarray) -> Any:
        """Pose of ``base_link`` in ``odom``."""
        types = self.store.types
        x, y, z, w = quaternion_from_rotation(T[:3, :3])
        zero = types["geometry_msgs/msg/Vector3"](x=0.0, y=0.0, z=0.0)
        twist = types["geometry_msgs/msg/Twist"](linear=zero, angular=zero)
        place = types["geometry_msgs/msg/Point"](*T[:3, 3].tolist())
        turn = types["geometry_msgs/msg/Quaternion"](x=x, y=y, z=z, w=w)
        pose = types["geometry_msgs/msg/Pose"](position=place, orientation=turn)
        return types["nav_msgs/msg/Odometry"](
            header=self.header(stamp_ns, "odom"), child_frame_id="base_link",
            pose=types["geometry_msgs/msg/PoseWithCovariance"](pose=pose, covariance=np.zeros(36)),
            twist=types["geometry_msgs/msg/TwistWithCovariance"](
                twist=twist, covariance=np.zeros(36)
            ),
        )  # fmt: skip

    def transform(self, stamp_ns: int, parent: str, child: str, T: np.ndarray) -> Any:
        types = self.store.types
        x, y, z, w = quaternion_from_rotation(T[:3, :3])
        moved = types["geometry_msgs/msg/Transform"](
            translation=types["geometry_msgs/msg/Vector3"](*T[:3, 3].tolist()),
            rotation=types["geometry_msgs/msg/Quaternion"](x=x, y=y, z=z, w=w),
        )
        return types["geometry_msgs/msg/TransformStamped"](
            header=self.header(stamp_ns, parent), child_frame_id=child, transform=moved
        )

    def transforms(self, *parts: Any) -> Any:
        return self.store.types["tf2_msgs/msg/TFMessage"](transforms=list(parts))

    def camera_info(self, stamp_ns: int, camera: RectifiedCamera, P: np.ndarray) -> Any:
        types = self.store.types
        roi = types["sensor_msgs/msg/RegionOfInterest"](
            x_offset=0, y_offset=0, height=0, width=0, do_rectify=False
        )
        matrices = {
            "D": np.zeros(5), "K": P[:, :3].ravel().copy(),
            "R": np.eye(3).ravel(), "P": P.ravel().copy(),
        }  # fmt: skip
        named = {k if self.ros1 else k.lower(): v for k, v in matrices.items()}
        return types["sensor_msgs/msg/CameraInfo"](
            header=self.header(stamp_ns), height=camera.height_px, width=camera.width_px,
            distortion_model="plumb_bob", binning_x=0, binning_y=0, roi=roi, **named,
        )  # fmt: skip


@contextmanager
def recorder(folder: Path, how: Recording) -> Iterator[Recorder]:
    folder.mkdir(parents=True, exist_ok=True)
    path = folder / how.name
    if how.kind == "ros1":
        opened: Any = Writer1(path)
    else:
        plugin = StoragePlugin.MCAP if how.kind == "mcap" else StoragePlugin.SQLITE3
        opened = Writer2(path, version=9, storage_plugin=plugin)
    with opened as writer:
        yield Recorder(writer, how)


def write_bag(
    pairs: list[StereoPair], camera: RectifiedCamera, folder: Path, how: Recording
) -> Path:
    """Left and right messages are not adjacent: the right one is recorded a frame later."""
    with recorder(folder, how) as bag:
        late: list[tuple[int, Any]] = []
        for number, pair in enumerate(pairs):
            stamp = EPOCH_S * 10**9 + round(pair.timestamp_s * 1e9)
            if how.odometry is not None:
                bag.write("/odom", stamp, bag.odometry(stamp, how.odometry[number]))
            for topic, P in zip(how.topics, projections(camera), strict=True):
                if how.info:
                    name = topic.removesuffix("/compressed").rsplit("/", 1)[0] + "/camera_info"
                    bag.write(name, stamp, bag.camera_info(stamp, camera, P))
            for recorded, message in late:
                bag.write(how.topics[1], recorded, message)
            bag.write(how.topics[0], stamp + 1_000_000, bag.image(stamp, pair.left))
            late = [(stamp + 105_000_000, bag.image(stamp, pair.right))]
        for recorded, message in late:
            bag.write(how.topics[1], recorded, message)
    path = folder / how.name
    return next(path.glob("*.mcap")) if how.kind == "mcap" else path


def bag(**how: Any) -> Writer:
    """Return what writes bags in this way."""
    return lambda pairs, camera, folder: write_bag(pairs, camera, folder, Recording(**how))
