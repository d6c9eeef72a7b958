"""Builds a rig from two CameraInfo messages."""

from __future__ import annotations

from pathlib import Path

import numpy as np

from recon.core.errors import CalibrationError
from recon.core.values import CameraIntrinsics, RectifiedCamera
from recon.io.cameras.camera_info import check_shift, rig_of_camera_infos
from recon.io.cameras.lens_models import ROS_MODELS, lens_of
from recon.io.files import reading
from recon.sources.rig import Rig
from recon.sources.rosbags import BagCameraInfo


def rig_of_messages(left: BagCameraInfo, right: BagCameraInfo, where: Path, rectified: bool) -> Rig:
    """Build a rig from two CameraInfo messages.

    Args:
        left: Message of the left camera.
        right: Message of the right camera.
        where: The recording, for error messages.
        rectified: Whether the images are rectified, so that only ``P`` is used.

    Raises:
        FormatError: The lens model is not supported.
        CalibrationError: The calibration cannot give depth, as with an uncalibrated camera.
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
    with reading(where):
        return RectifiedCamera(
            focal_px=float(left.P[0, 0]),
            cx_px=float(left.P[0, 2]),
            cy_px=float(left.P[1, 2]),
            cx_right_px=float(right.P[0, 2]),
            baseline_m=float((left.P[0, 3] - right.P[0, 3]) / left.P[0, 0]),
            width_px=left.width_px,
            height_px=left.height_px,
        )


def _camera(info: BagCameraInfo, where: Path) -> CameraIntrinsics:
    # Drivers of rectified images may leave the model empty.
    name = info.model or "plumb_bob"
    model, distortion = lens_of(ROS_MODELS, name, np.asarray(info.D), where)
    with reading(where):
        return CameraIntrinsics(info.K, distortion, info.width_px, info.height_px, model)
