"""Finds the topics of the two cameras in a bag, and the rig that their CameraInfo describes."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path, PurePosixPath

import numpy as np

from recon.core.errors import CalibrationError, SourceError
from recon.core.values import CameraIntrinsics, RectifiedCamera, Rig
from recon.io.cameras.camera_info import check_shift, rig_of_camera_infos
from recon.io.cameras.lens_models import ROS_MODELS, lens_of
from recon.io.files import reading
from recon.sources.image_names import find_partners, partner_names
from recon.sources.rosbags import CAMERA_INFO, COMPRESSED, IMAGE, POSES, Bag, BagCameraInfo
from recon.sources.settings import SourceSettings

_IMAGES = (IMAGE, COMPRESSED)
_LISTED = 20


def choose_topics(bag: Bag, settings: SourceSettings) -> tuple[tuple[str, str], str]:
    """Return the left and right image topic: from the settings, else guessed from the topic names.

    Of several pairs, rectified ones are preferred, then uncompressed ones, then alphabetical order.

    Returns:
        The topics, and a note on other candidate pairs.
    """
    if settings.left or settings.right:
        return _named(bag, settings), ""
    images = [
        topic.name
        for topic in bag.topics.values()
        if topic.kind in _IMAGES and topic.messages and "depth" not in topic.name.lower()
    ]
    pairs = [
        (left, right)
        for left, right in find_partners(images)
        if bag.topics[left].kind == bag.topics[right].kind
    ]
    if not pairs:
        raise SourceError(
            "recording has no image topics of a left and a right camera",
            where=bag.paths[0],
            got=list_topics(bag, _IMAGES) or "no image topic",
            hint="name them with --left and --right",
        )
    best, *others = sorted(pairs, key=lambda pair: _rank(bag, pair[0]))
    also = ", ".join(left for left, _ in others)
    return best, f" (also there: {also}; choose with --left)" if also else ""


def list_topics(bag: Bag, kinds: Sequence[str]) -> str:
    """List the topics of some types with their message counts, for error messages."""
    return ", ".join(
        f"{topic.name} ({topic.messages})"
        for topic in sorted(bag.topics.values(), key=lambda topic: topic.name)
        if topic.kind in kinds
    )


def list_others(bag: Bag, used: Sequence[str]) -> str:
    """Return a note on the topics that are not used, and on those that `--prior` takes.

    Other pairs of image topics are not among them; see `choose_topics`.
    """
    images = [topic.name for topic in bag.topics.values() if topic.kind in _IMAGES]
    named = {*used, *(name for pair in find_partners(images) for name in pair)}
    others = sorted(
        t.name for t in bag.topics.values() if t.kind != CAMERA_INFO and t.name not in named
    )
    if not others:
        return ""
    poses = [name for name in others if bag.topics[name].kind in POSES and "static" not in name]
    listed = ", ".join(others[:_LISTED]) + (" …" if len(others) > _LISTED else "")
    return f", not used: {listed}" + (f" (for --prior: {', '.join(poses)})" if poses else "")


def camera_info_topic(bag: Bag, image_topic: str) -> str | None:
    """Return the CameraInfo topic of an image topic: at the same level, or one level up."""
    place = PurePosixPath(image_topic.removesuffix("/compressed")).parent
    for candidate in (place / "camera_info", place.parent / "camera_info"):
        topic = bag.topics.get(str(candidate))
        if topic is not None and topic.kind == CAMERA_INFO and topic.messages:
            return topic.name
    return None


def names_rectified(image_topic: str) -> bool:
    """Return whether a topic has rectified images, according to ROS naming conventions."""
    return "rect" in image_topic.removesuffix("/compressed").rsplit("/", 1)[-1]


def _named(bag: Bag, settings: SourceSettings) -> tuple[str, str]:
    left, right = settings.left, settings.right
    if right is None and left is not None:
        right = next((name for name in partner_names(left) if name in bag.topics), None)
    if left is None:
        left = next((one for one, other in find_partners(bag.topics) if other == right), None)
    for name in (left, right):
        if name is None or name not in bag.topics or bag.topics[name].kind not in _IMAGES:
            raise SourceError(
                "recording has no such image topic",
                where=bag.paths[0],
                got=name or "one name alone",
                expected=list_topics(bag, _IMAGES) or "an image topic",
            )
    return str(left), str(right)


def _rank(bag: Bag, topic: str) -> tuple[bool, bool, str]:
    return not names_rectified(topic), bag.topics[topic].kind == COMPRESSED, topic


def rig_of_messages(left: BagCameraInfo, right: BagCameraInfo, where: Path, rectified: bool) -> Rig:
    """Build a rig from two CameraInfo messages.

    Args:
        left: Message of the left camera.
        right: Message of the right camera.
        where: The recording, for error messages.
        rectified: Whether the images are rectified, so that only ``P`` is used.
    """
    for info in (left, right):
        if not info.P[0, 0] > 0 or not info.K[0, 0] > 0:
            raise CalibrationError(
                "CameraInfo is of a camera that is not calibrated",
                where=where,
                got=f"focal length {info.P[0, 0]:g} px",
                hint="name a calibration file with --calib",
            )
    if rectified:
        return _rectified(left, right, where)
    cameras = [(_camera(info, where), info.R) for info in (left, right)]
    return rig_of_camera_infos(cameras[0], cameras[1], right.P, where)


def _rectified(left: BagCameraInfo, right: BagCameraInfo, where: Path) -> RectifiedCamera:
    check_shift(right.P, float(left.P[0, 3]), where)
    baseline_m = (left.P[0, 3] - right.P[0, 3]) / left.P[0, 0]
    size = (left.width_px, left.height_px)
    with reading(where):
        return RectifiedCamera.from_matrices(left.P, right.P, baseline_m, *size)


def _camera(info: BagCameraInfo, where: Path) -> CameraIntrinsics:
    # Drivers of rectified images may leave the model empty.
    name = info.model or "plumb_bob"
    model, distortion = lens_of(ROS_MODELS, name, np.asarray(info.D), where)
    with reading(where):
        return CameraIntrinsics(info.K, distortion, info.width_px, info.height_px, model)
