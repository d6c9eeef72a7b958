"""Writes bags of a drive as recorders do, optionally damaged."""

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
from recon.core.values import RectifiedCamera
from tests.scenery.kitti import projections
from tests.sources.drives import Pairs, Writer, stamp_ns

TOPICS = ("/stereo/left/image_rect", "/stereo/right/image_rect")


@dataclass(frozen=True)
class Recording:
    kind: str  # ros1, ros2 or mcap
    topics: tuple[str, str] = TOPICS
    compressed: bool = False  # PNG messages
    info: bool = True  # CameraInfo
    stamped: bool = True
    encoding: str = "mono8"
    odometry: np.ndarray | None = None  # T_odom_base of each pair, (N, 4, 4), on ``/odom``

    def path(self, folder: Path) -> Path:
        drive = folder / ("drive.bag" if self.kind == "ros1" else "drive")
        return next(drive.glob("*.mcap"), drive) if self.kind == "mcap" else drive


class Recorder:
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

    def make(self, kind: str, *values: Any, **fields: Any) -> Any:
        return self.store.types[kind.replace("/", "/msg/")](*values, **fields)

    def header(self, stamp_ns: int, frame_id: str = "cam") -> Any:
        time = self.make("builtin_interfaces/Time", sec=stamp_ns // 10**9, nanosec=stamp_ns % 10**9)
        extra = {"seq": 0} if self.ros1 else {}
        return self.make("std_msgs/Header", stamp=time, frame_id=frame_id, **extra)

    def image(self, stamp_ns: int, image: np.ndarray) -> Any:
        header = self.header(stamp_ns if self.how.stamped else 0)
        if self.how.compressed:
            data, form = cv2.imencode(".png", image)[1].ravel(), "mono8; png compressed"
            return self.make("sensor_msgs/CompressedImage", header=header, format=form, data=data)
        height, width = image.shape[:2]
        padded = np.zeros((height, image[0].size + 3), np.uint8)  # rows end in padding
        padded[:, :-3] = image.reshape(height, -1)
        return self.make(
            "sensor_msgs/Image", header=header, height=height, width=width,
            encoding=self.how.encoding, is_bigendian=0, step=padded.shape[1], data=padded.ravel(),
        )  # fmt: skip

    def place(self, T: np.ndarray, point: str = "Point") -> tuple[Any, Any]:
        x, y, z, w = quaternion_from_rotation(T[:3, :3])
        turn = self.make("geometry_msgs/Quaternion", x=x, y=y, z=z, w=w)
        return self.make(f"geometry_msgs/{point}", *T[:3, 3].tolist()), turn

    def odometry(self, stamp_ns: int, T: np.ndarray) -> Any:
        zero = self.make("geometry_msgs/Vector3", x=0.0, y=0.0, z=0.0)
        pose = self.make("geometry_msgs/Pose", *self.place(T))
        twist = self.make("geometry_msgs/Twist", zero, zero)
        return self.make(
            "nav_msgs/Odometry", header=self.header(stamp_ns, "odom"), child_frame_id="base_link",
            pose=self.make("geometry_msgs/PoseWithCovariance", pose, np.zeros(36)),
            twist=self.make("geometry_msgs/TwistWithCovariance", twist, np.zeros(36)),
        )  # fmt: skip

    def imu(self, stamp_ns: int, gyro: np.ndarray, accel: np.ndarray, frame_id: str) -> Any:
        rates, forces = (self.make("geometry_msgs/Vector3", *v.tolist()) for v in (gyro, accel))
        none = self.make("geometry_msgs/Quaternion", x=0.0, y=0.0, z=0.0, w=1.0)
        header = self.header(stamp_ns, frame_id)
        parts = (header, none, np.zeros(9), rates, np.zeros(9), forces, np.zeros(9))
        return self.make("sensor_msgs/Imu", *parts)

    def fix(self, stamp_ns: int, place: np.ndarray, sigma_m: Any = None, status: int = 2) -> Any:
        known = np.zeros(3) if sigma_m is None else np.square(sigma_m)
        state = self.make("sensor_msgs/NavSatStatus", status=status, service=1)
        return self.make(
            "sensor_msgs/NavSatFix", header=self.header(stamp_ns, "gps"), status=state,
            latitude=place[0], longitude=place[1], altitude=place[2],
            position_covariance=np.diag(known).ravel(),
            position_covariance_type=0 if sigma_m is None else 2,
        )  # fmt: skip

    def transform(self, stamp_ns: int, parent: str, child: str, T: np.ndarray) -> Any:
        moved = self.make("geometry_msgs/Transform", *self.place(T, "Vector3"))
        header = self.header(stamp_ns, parent)
        return self.make("geometry_msgs/TransformStamped", header, child, moved)

    def transforms(self, *parts: Any) -> Any:
        return self.make("tf2_msgs/TFMessage", transforms=list(parts))

    def camera_infos(
        self, stamp_ns, camera, topics=TOPICS, size=None, *,
        binning=(0, 0), part=(0, 0, 0, 0), **others,
    ):  # fmt: skip
        """Write CameraInfo of rectified images; ``others`` than its fields, and another size."""
        width_px, height_px = size or (camera.width_px, camera.height_px)
        roi = self.make(
            "sensor_msgs/RegionOfInterest",
            x_offset=part[0], y_offset=part[1], width=part[2], height=part[3], do_rectify=False,
        )  # fmt: skip
        for topic, P in zip(topics, projections(camera), strict=True):
            K = P[:, :3].ravel().copy()
            named = {"D": np.zeros(5), "K": K, "R": np.eye(3).ravel(), "P": P.ravel().copy()}
            named |= {name: np.array(value, np.float64) for name, value in others.items()}
            info = self.make(
                "sensor_msgs/CameraInfo", header=self.header(stamp_ns), height=height_px,
                width=width_px, distortion_model="plumb_bob", binning_x=binning[0],
                binning_y=binning[1], roi=roi,
                **{k if self.ros1 else k.lower(): v for k, v in named.items()},
            )  # fmt: skip
            place = topic.removesuffix("/compressed").rsplit("/", 1)[0]
            self.write(f"{place}/camera_info", stamp_ns, info)


@contextmanager
def recorder(folder: Path, how: Recording) -> Iterator[Recorder]:
    folder.mkdir(parents=True, exist_ok=True)
    path = how.path(folder)
    if how.kind == "ros1":
        opened: Any = Writer1(path)
    else:
        plugin = StoragePlugin.MCAP if how.kind == "mcap" else StoragePlugin.SQLITE3
        opened = Writer2(path, version=9, storage_plugin=plugin)
    with opened as writer:
        yield Recorder(writer, how)


def write_bag(pairs: Pairs, camera: RectifiedCamera, folder: Path, how: Recording) -> Path:
    """Left and right messages are not adjacent: the right one is recorded a frame later."""
    with recorder(folder, how) as bag:
        late: list[tuple[int, Any]] = []
        for number, pair in enumerate(pairs):
            stamp = stamp_ns(pair)
            if how.odometry is not None:
                bag.write("/odom", stamp, bag.odometry(stamp, how.odometry[number]))
            if how.info:
                bag.camera_infos(stamp, camera, how.topics)
            for recorded, message in late:
                bag.write(how.topics[1], recorded, message)
            bag.write(how.topics[0], stamp + 1_000_000, bag.image(stamp, pair.left))
            late = [(stamp + 105_000_000, bag.image(stamp, pair.right))]
        for recorded, message in late:
            bag.write(how.topics[1], recorded, message)
    return how.path(folder)


def bag(**how: Any) -> Writer:
    return lambda pairs, camera, folder: write_bag(pairs, camera, folder, Recording(**how))
