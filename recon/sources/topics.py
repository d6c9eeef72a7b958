"""Which topics are those of a stereo camera, in a recording or on a network, and its rig."""

from __future__ import annotations

import re
from collections.abc import Callable, Mapping, Sequence
from pathlib import PurePosixPath
from typing import Final, NamedTuple

import numpy as np

from recon.core.errors import CalibrationError, SourceError
from recon.core.geometry.se3 import invert, make_transform, orthonormalise
from recon.core.values import CameraIntrinsics, Rig, StereoCalibration, check_side_by_side
from recon.core.values.arrays import Float64
from recon.io.cameras.kitti import projected_rig
from recon.io.cameras.named import lens_called
from recon.io.cameras.ros import are_rectified, rig_of_camera_infos, step_between
from recon.io.files import StrPath, reading
from recon.io.ros.contents import CAMERA_INFO, COMPRESSED, IMAGE, IMU, VIDEOS, BagCameraInfo
from recon.sources.calibration import CALIBRATE, as_rectified
from recon.sources.images import find_partners, partner_names
from recon.sources.settings import SourceSettings

IMAGES: Final = (IMAGE, COMPRESSED, *VIDEOS)
_TRANSPORT: Final = re.compile("/(compressed|ffmpeg)$")  # in names, after that of the images


class Topic(NamedTuple):
    """A topic: its name, message type and number of messages; None = they are still to come."""

    name: str
    kind: str
    messages: int | None = None

    @property
    def empty(self) -> bool:
        return self.messages == 0

    def __str__(self) -> str:
        return self.name if self.messages is None else f"{self.name} ({self.messages})"


Topics = Mapping[str, Topic]
Between = Callable[[], Float64 | None]  # gives T_right_left (4, 4) of the images; None = unknown


def list_topics(topics: Topics, kinds: Sequence[str]) -> str:
    """Return the topics of some message types, in words; empty if there are none."""
    return ", ".join(str(topics[name]) for name in sorted(topics) if topics[name].kind in kinds)


def info_topics(topics: Topics, images: Sequence[str], where: StrPath) -> list[str]:
    """Return the CameraInfo topics of two image topics; `SourceError` if one has none."""
    names = [name for name in (info_topic(topics, image) for image in images) if name is not None]
    if len(names) < 2:
        what = "there is no calibration of both cameras"
        got = list_topics(topics, (CAMERA_INFO,)) or "no CameraInfo"
        raise SourceError(what, where=where, got=got, hint=CALIBRATE)
    return names


def rig_of_infos(
    left: BagCameraInfo,
    right: BagCameraInfo,
    images: Sequence[str],
    where: StrPath,
    size: tuple[int, int],
    between: Between = lambda: None,
) -> tuple[Rig, str]:
    """Return the rig of the CameraInfo of images (width, height), and a note on it or none."""
    left, right = (_of_images(one, size, where) for one in (left, right))
    stated, rectified = (left.width_px, left.height_px), all(map(is_rectified, images))
    other = are_rectified((left.K, right.K), (left.P, right.P), stated, size)
    if other or 0 in stated:
        left, right = (one._replace(width_px=size[0], height_px=size[1]) for one in (left, right))
    note = (
        f"K and D of the CameraInfo are not of these images of {size[0]}x{size[1]} pixels, "
        "and P is: they are taken as rectified"
    )
    rig = as_rectified(rig_of_messages(left, right, where, rectified or other, between))
    return rig, note if other and not rectified else ""


def _of_images(info: BagCameraInfo, size: tuple[int, int], where: StrPath) -> BagCameraInfo:
    """Return the CameraInfo of images of which a part of the sensor is cut out, then binned."""
    stated, (x, y, *part) = (info.width_px, info.height_px), info.part
    cut = np.array(part if all(part) else stated)
    if size == stated or size != tuple(cut // info.binning):
        return info
    if x + cut[0] > stated[0] or y + cut[1] > stated[1]:
        what, got = "region of interest is beyond the image", f"{cut[0]}x{cut[1]} at ({x}, {y})"
        expected = f"within {stated[0]}x{stated[1]}"
        raise CalibrationError(f"CameraInfo: {what}", where=where, got=got, expected=expected)
    # The centre of a pixel is the middle of those that it is of.
    to_cut = np.diag([*(1 / np.array(info.binning)), 1.0])
    to_cut[:2, 2] = (0.5 - np.array([x, y])) / info.binning - 0.5
    K, P = to_cut @ info.K, to_cut @ info.P
    return info._replace(K=K, P=P, width_px=size[0], height_px=size[1])


def choose_topics(
    topics: Topics, settings: SourceSettings, where: StrPath
) -> tuple[tuple[str, str], str]:
    """Return both topics by the settings, else the best pair by name, and a note on others."""
    if settings.left or settings.right:
        return _named(topics, settings, where), ""
    images = [
        topic.name
        for topic in topics.values()
        if topic.kind in IMAGES and not topic.empty and "depth" not in topic.name.lower()
    ]
    ranked = sorted(
        (not is_rectified(left), topics[left].kind != IMAGE, left, right)
        for left, right in find_partners(images)
        if topics[left].kind == topics[right].kind
    )
    if not ranked:
        what = "there are no image topics of a left and a right camera"
        got = list_topics(topics, IMAGES) or "no image topic"
        hint = "name them with --left and --right"
        raise SourceError(what, where=where, got=got, hint=hint)
    best, *others = [(left, right) for *_, left, right in ranked]
    also = ", ".join(left for left, _ in others)
    return best, f" (also there: {also}; choose with --left)" if also else ""


def info_topic(topics: Topics, image_topic: str) -> str | None:
    """Return the CameraInfo topic of an image topic: at the same level, or one level up."""
    place = PurePosixPath(_TRANSPORT.sub("", image_topic)).parent
    for candidate in (place / "camera_info", place.parent / "camera_info"):
        topic = topics.get(str(candidate))
        if topic is not None and topic.kind == CAMERA_INFO and not topic.empty:
            return topic.name
    return None


def is_rectified(image_topic: str) -> bool:
    """Return whether the name of a topic says that its images are rectified."""
    return "rect" in _TRANSPORT.sub("", image_topic).rsplit("/", 1)[-1]


def _named(topics: Topics, settings: SourceSettings, where: StrPath) -> tuple[str, str]:
    left, right = settings.left, settings.right
    if right is None and left is not None:
        right = next((name for name in partner_names(left) if name in topics), None)
    if left is None:
        left = next((one for one, other in find_partners(topics) if other == right), None)
    for name in (left, right):
        if name is None or name not in topics or topics[name].kind not in IMAGES:
            what = "there is no such image topic"
            got, expected = (
                name or "one name alone",
                list_topics(topics, IMAGES) or "an image topic",
            )
            raise SourceError(what, where=where, got=got, expected=expected)
    return str(left), str(right)


def rig_of_messages(
    left: BagCameraInfo,
    right: BagCameraInfo,
    where: StrPath,
    rectified: bool,
    between: Between = lambda: None,
) -> Rig:
    """Return the rig of CameraInfo, of rectified images by ``P`` alone, else by ``between``."""
    for info in (left, right):
        if not info.P[0, 0] > 0 or not info.K[0, 0] > 0:
            what = "CameraInfo is of a camera that is not calibrated"
            got, hint = f"focal length {info.P[0, 0]:g} px", "name a calibration file with --calib"
            raise CalibrationError(what, where=where, got=got, hint=hint)
    if np.array_equal(left.P[:, 3], right.P[:, 3]):
        T_right_left = between()
        if T_right_left is not None and T_right_left[:3, 3].any():
            return _rig_between(left, right, where, rectified, T_right_left)
    if not rectified:
        cameras = [(_camera(info, where), info.R) for info in (left, right)]
        return rig_of_camera_infos(cameras[0], cameras[1], (left.P, right.P), where)
    step_between((left.P, right.P), where)
    named = {"P of the left": left.P, "P of the right": right.P}
    with reading(where):
        return projected_rig(named, left.width_px, left.height_px)


def _rig_between(
    left: BagCameraInfo, right: BagCameraInfo, where: StrPath, rectified: bool, T: Float64
) -> StereoCalibration:
    """Return the rig of cameras whose frames are known, ``T_right_left`` (4, 4)."""
    sides = [left, right]
    if rectified:  # each by itself
        left_turn, right_turn = (make_transform(one.R, np.zeros(3)) for one in sides)
        T = orthonormalise(right_turn @ T @ invert(left_turn))
        sides = [one._replace(K=one.P[:, :3], D=np.zeros(5), model="plumb_bob") for one in sides]
    with reading(where):
        check_side_by_side(T[:3, 3])
        return StereoCalibration(_camera(sides[0], where), _camera(sides[1], where), T)


def _camera(info: BagCameraInfo, where: StrPath) -> CameraIntrinsics:
    with reading(where):
        # Drivers of rectified images may leave the model empty.
        model = lens_called(info.model or "plumb_bob")
        return CameraIntrinsics(info.K, info.D, info.width_px, info.height_px, model)


def find_imu(topics: Topics) -> str | None:
    """Return the topic of an inertial unit; of several, one of all that it measures."""
    found = [topic for topic in topics.values() if topic.kind == IMU and not topic.empty]
    ranked = sorted(found, key=lambda topic: ("accel" in topic.name, "imu" not in topic.name,
                                              -(topic.messages or 0), topic.name))  # fmt: skip
    return ranked[0].name if ranked else None
