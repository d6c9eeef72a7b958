"""Plays a drive as topics of ROS 2: `python -m tests.scenery.ros2_player DRIVE [--rate R] …`."""

from __future__ import annotations

import argparse
import sys
import time
from typing import Any

import cv2
import numpy as np

from recon.core.geometry.se3 import make_transform
from recon.core.values import RectifiedCamera, StereoPair
from recon.core.values.arrays import Float64, UInt8
from recon.io.images.image import encode_image
from recon.io.ros.dds import Network
from recon.io.ros.messages import Message, header, transforms
from recon.sources.registry import open_source
from recon.sources.source import StereoSource

OPTICAL = np.array([[0.0, 0.0, 1.0], [-1.0, 0.0, 0.0], [0.0, -1.0, 0.0]])
CAMERA_HEIGHT_M = 1.65


def info_messages(source: StereoSource, time_ns: int) -> list[Message]:
    """Return the CameraInfo of both cameras, of a rectified camera or of a raw rig."""
    rig = source.calibration
    if isinstance(rig, RectifiedCamera):
        size, still = (rig.width_px, rig.height_px), np.eye(3)
        shift = np.array([[-rig.focal_px * rig.baseline_m], [0.0], [0.0]])
        matrices = (rig.matrix, 0.0 * shift), (rig.right_matrix, shift)
        made = [(K, np.zeros(5), still, np.hstack([K, last])) for K, last in matrices]
    else:
        size, T = (rig.left.width_px, rig.left.height_px), rig.T_right_left
        known = [one for side in (rig.left, rig.right) for one in (side.matrix, side.distortion)]
        turns_and_views = cv2.stereoRectify(*known, size, T[:3, :3].copy(), T[:3, 3:].copy())[:4]
        views = zip(turns_and_views[:2], turns_and_views[2:], strict=True)
        cameras = zip((rig.left, rig.right), views, strict=True)
        made = [(c.matrix, np.resize([*c.distortion, 0.0], 5), R, P) for c, (R, P) in cameras]
    return [
        ("sensor_msgs/msg/CameraInfo", {
            "header": header(side, time_ns), "width": size[0], "height": size[1],
            "distortion_model": "plumb_bob", "d": D, "k": K.ravel(), "r": R.ravel(),
            "p": P.ravel()})
        for side, (K, D, R, P) in zip(("left", "right"), made, strict=True)
    ]  # fmt: skip


def image_message(image: UInt8, side: str, time_ns: int, *, compressed: bool) -> Message:
    head = header(side, time_ns)
    if compressed:
        data = np.frombuffer(encode_image(image, ".jpg", side), np.uint8)
        return "sensor_msgs/msg/CompressedImage", {"header": head, "format": "jpeg", "data": data}
    encoding, channels = ("mono8", 1) if image.ndim == 2 else ("rgb8", 3)
    content = {
        "header": head, "height": image.shape[0], "width": image.shape[1], "encoding": encoding,
        "step": channels * image.shape[1], "data": image.reshape(-1),
    }  # fmt: skip
    return "sensor_msgs/msg/Image", content


def mount() -> list[tuple[str, str, Float64]]:
    T = make_transform(OPTICAL, np.array([0.3, 0.0, CAMERA_HEIGHT_M]))
    return [("base_footprint", "base_link", np.eye(4)), ("base_link", "left", T)]


def stand(network: Network, source: StereoSource, options: argparse.Namespace) -> None:
    """Publish the first pair again and again until somebody publishes a topic: a robot waits."""
    pair = next(iter(source.frames(options.start)))
    while options.stand is not None and options.stand not in network.topics():
        publish(network, source, pair, time.time_ns(), compressed=options.compressed)
        time.sleep(0.1)


def play(network: Network, source: StereoSource, options: argparse.Namespace) -> None:
    """Publish the pairs at their own pace, with stamps of now."""
    first, begun_s, ahead_s = None, time.time(), 0.0
    imu = source.read_imu() if options.imu else None
    sent_until_s = -np.inf
    for pair in source.frames(options.start):
        first = pair.timestamp_s if first is None else first
        due_s = begun_s + (pair.timestamp_s - first) / options.rate
        time.sleep(max(0.0, due_s - time.time() - ahead_s))
        time_ns = round(1e9 * due_s)
        if imu is not None:
            new = (imu.timestamps_s > sent_until_s) & (imu.timestamps_s <= pair.timestamp_s + 0.02)
            for at_s, gyro, accel in zip(
                imu.timestamps_s[new], imu.gyro[new], imu.accel[new], strict=True
            ):
                at_ns = round(1e9 * (begun_s + (at_s - first) / options.rate))
                network.write("/imu", at_ns, imu_message(at_ns, gyro, accel))
            sent_until_s = pair.timestamp_s + 0.02
        publish(network, source, pair, time_ns, compressed=options.compressed)
        if pair.index + 1 == options.end:
            return


def publish(
    network: Network, source: StereoSource, pair: StereoPair, time_ns: int, *, compressed: bool
) -> None:
    infos = info_messages(source, time_ns)
    sides = zip(("left", "right"), (pair.left, pair.right), infos, strict=True)
    for side, image, info in sides:
        name = f"/{side}/image_raw" + ("/compressed" if compressed else "")
        network.write(name, time_ns, image_message(image, side, time_ns, compressed=compressed))
        network.write(f"/{side}/camera_info", time_ns, info)


def imu_message(time_ns: int, gyro: Float64, accel: Float64) -> Message:
    xyz = [dict(zip("xyz", one.tolist(), strict=True)) for one in (gyro, accel)]
    nine: dict[str, Any] = {
        f"{name}_covariance": np.zeros(9)
        for name in ("orientation", "angular_velocity", "linear_acceleration")
    }
    content = {"header": header("imu", time_ns), "angular_velocity": xyz[0],
               "linear_acceleration": xyz[1], **nine}  # fmt: skip
    return "sensor_msgs/msg/Imu", content


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("drive")
    parser.add_argument("--rate", type=float, default=1.0)
    parser.add_argument("--start", type=int, default=0)
    parser.add_argument("--end", type=int, default=None)
    parser.add_argument("--compressed", action="store_true")
    parser.add_argument("--imu", action="store_true")
    parser.add_argument("--stand", metavar="TOPIC", help="wait until it is published")
    parser.add_argument("--domain", type=int, default=None)
    options = parser.parse_args()
    source = open_source(options.drive)
    network = Network(options.domain)
    edges, imu = mount(), source.read_imu() if options.imu else None
    if imu is not None and imu.T_camera_imu is not None:
        edges.append(("left", "imu", imu.T_camera_imu))
    network.write("/tf_static", 0, transforms(time.time_ns(), edges), kept=True)
    stand(network, source, options)
    sys.stderr.write(f"playing {source.name}\n")
    play(network, source, options)
    time.sleep(0.5)
    network.close()


if __name__ == "__main__":
    main()
