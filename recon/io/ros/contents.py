"""What we read of messages of ROS 1 and 2: images, cameras, poses, inertial units, receivers."""

from __future__ import annotations

from collections.abc import Iterator
from typing import Any, Final, NamedTuple

import numpy as np
from numpy.typing import NDArray

from recon.core.errors import FormatError
from recon.core.values.arrays import Float64
from recon.io.images.image import decode_levels, pixels_of_ros_image
from recon.io.images.packets import codec_of
from recon.io.ros.messages import NS_PER_S

IMAGE: Final = "sensor_msgs/msg/Image"
COMPRESSED: Final = "sensor_msgs/msg/CompressedImage"
VIDEO: Final = "foxglove_msgs/msg/CompressedVideo"
PACKET: Final = "ffmpeg_image_transport_msgs/msg/FFMPEGPacket"
#: Fields of messages with a frame of a video each, which rosbags does not bring.
VIDEOS: Final = {
    VIDEO: "builtin_interfaces/Time timestamp\nstring frame_id\nuint8[] data\nstring format",
    PACKET: "std_msgs/Header header\nint32 width\nint32 height\nstring encoding\nuint64 pts\n"
    "uint8 flags\nbool is_bigendian\nuint8[] data",
}
CAMERA_INFO: Final = "sensor_msgs/msg/CameraInfo"
FIX: Final = "sensor_msgs/msg/NavSatFix"
IMU: Final = "sensor_msgs/msg/Imu"
TRANSFORMS: Final = ("tf2_msgs/msg/TFMessage", "tf/msg/tfMessage")
POSES: Final = (
    "nav_msgs/msg/Odometry",
    "geometry_msgs/msg/PoseStamped",
    "geometry_msgs/msg/PoseWithCovarianceStamped",
    "geometry_msgs/msg/TransformStamped",
    *TRANSFORMS,
)


class BagCameraInfo(NamedTuple):
    """``sensor_msgs/CameraInfo``: float64 D (N,), K (3, 3) raw, R (3, 3), P (3, 4) rectified."""

    width_px: int
    height_px: int
    model: str
    D: Float64
    K: Float64
    R: Float64
    P: Float64
    binning: tuple[int, int] = (1, 1)  # columns and rows of the sensor in a pixel
    part: tuple[int, int, int, int] = (0, 0, 0, 0)  # of the sensor: x, y, width, height; 0 = all


class BagPose(NamedTuple):
    """The pose of frame ``child`` (empty = the message does not say) in frame ``parent``."""

    recorded_ns: int
    stamp_ns: int  # of the header; 0 = none
    parent: str
    child: str
    xyz_m: Float64
    xyzw: Float64


def stamp_ns(message: Any) -> int:
    """Return the time in the header of a message."""
    return int(message.header.stamp.sec) * NS_PER_S + int(message.header.stamp.nanosec)


def levels_of(message: Any, where: str) -> NDArray[Any]:
    """Decode an image, raw or compressed: uint8 or uint16, (H, W) grey or (H, W, 3) RGB."""
    if hasattr(message, "format"):
        # Such as "bayer_rggb8; jpeg compressed": what was compressed, and how.
        encoding = str(message.format).partition(";")[0].strip()
        if codec_of(encoding) is not None:
            what, hint = "videos are not read while they arrive", "record a bag of them"
            raise FormatError(what, where=where, got=encoding, hint=hint)
        return decode_levels(message.data.tobytes(), encoding, where)
    shape, big_endian = (message.height, message.width), bool(message.is_bigendian)
    how = message.encoding, shape, message.step
    return pixels_of_ros_image(message.data, *how, big_endian=big_endian, where=where)


def camera_info_of(message: Any) -> BagCameraInfo:
    """Return what a CameraInfo says; field names of ROS 1 are upper-case."""
    names = "DKRP" if hasattr(message, "K") else "dkrp"
    D, K, R, P = (np.array(getattr(message, name), np.float64) for name in names)
    size, model = (int(message.width), int(message.height)), str(message.distortion_model)
    matrices, roi = (K.reshape(3, 3), R.reshape(3, 3), P.reshape(3, 4)), message.roi
    binning = max(1, int(message.binning_x)), max(1, int(message.binning_y))  # 0 = 1
    part = int(roi.x_offset), int(roi.y_offset), int(roi.width), int(roi.height)
    return BagCameraInfo(*size, model, D, *matrices, binning, part)


def poses_of(message: Any, recorded_ns: int) -> Iterator[BagPose]:
    """Yield the poses of a message of one of the `POSES`."""
    for part in getattr(message, "transforms", [message]):
        if hasattr(part, "transform"):
            place, turn = part.transform.translation, part.transform.rotation
        else:
            pose = getattr(part.pose, "pose", part.pose)  # wrapped beside a covariance
            place, turn = pose.position, pose.orientation
        yield BagPose(
            recorded_ns,
            stamp_ns(part),
            # Old recordings write frames with a leading slash.
            str(part.header.frame_id).lstrip("/"),
            str(getattr(part, "child_frame_id", "")).lstrip("/"),
            np.array([place.x, place.y, place.z], dtype=np.float64),
            np.array([turn.x, turn.y, turn.z, turn.w], dtype=np.float64),
        )


def imu_row(message: Any) -> list[float]:
    """Return angular rates [rad/s] and specific forces [m/s²]."""
    vectors = (message.angular_velocity, message.linear_acceleration)
    return [float(value) for one in vectors for value in (one.x, one.y, one.z)]
