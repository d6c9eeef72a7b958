"""Reads any supported calibration file, recognised by its content."""

from __future__ import annotations

import re
from typing import Final

from recon.errors import CalibrationError, FormatError
from recon.formats.camera_info import read_camera_info
from recon.formats.files import StrPath, read_text
from recon.formats.kalibr import read_kalibr
from recon.formats.kitti import COLOUR_CAMERAS, GREY_CAMERAS, list_kitti_cameras, read_kitti_calib
from recon.formats.middlebury_calib import read_middlebury_calib
from recon.formats.opencv_yaml import read_opencv_calibration
from recon.formats.recon_yaml import MARK, read_recon_calibration
from recon.structures import RectifiedCamera, StereoCalibration

_KITTI: Final = re.compile(r"^P(?:_rect_0)?\d:", re.MULTILINE)
_MIDDLEBURY: Final = re.compile(r"^\s*cam[01]\s*=", re.MULTILINE)
_OURS: Final = re.compile(rf"^format:\s*{MARK}", re.MULTILINE)
_CAMERA_INFO: Final = re.compile(r"^projection_matrix:", re.MULTILINE)
_KALIBR: Final = re.compile(r"^cam0:", re.MULTILINE)
_HOMOGRAPHIES: Final = re.compile(r"^H_left:", re.MULTILINE)
_OPENCV: Final = re.compile(r"^%YAML|<opencv_storage>|opencv-matrix")


def read_calibration(
    path: StrPath, width_px: int, height_px: int, *, metres_per_unit: float = 1.0
) -> RectifiedCamera | StereoCalibration:
    """Read a calibration file of any supported format.

    Supported are our own YAML, KITTI's ``calib.txt`` (the grey pair if it has one, else the colour
    pair), Middlebury's ``calib.txt``, OpenCV's ``FileStorage`` files, ROS CameraInfo (either of the
    two files; the other is expected in the same folder), and kalibr's camera chain.

    Args:
        path: The file.
        width_px: Image width, for formats that do not store it.
        height_px: Image height.
        metres_per_unit: Unit of the translation in an OpenCV file; other formats define theirs.

    Returns:
        A `RectifiedCamera` if the images are already rectified.

    Raises:
        FormatError: The file is missing, damaged or of an unknown format.
        CalibrationError: The calibration cannot give depth.
    """
    text = read_text(path)
    if _OURS.search(text):
        return read_recon_calibration(path)
    # OpenCV before KITTI: its extrinsics contain a ``P1:`` as well.
    if _OPENCV.search(text):
        return read_opencv_calibration(
            path, size_px=(width_px, height_px), metres_per_unit=metres_per_unit
        )
    if _CAMERA_INFO.search(text):
        return read_camera_info(path)
    if _KALIBR.search(text):
        return read_kalibr(path)
    if _MIDDLEBURY.search(text):
        return read_middlebury_calib(path).camera
    if _KITTI.search(text):
        known = list_kitti_cameras(path)
        grey = known.issuperset(GREY_CAMERAS) or not known.issuperset(COLOUR_CAMERAS)
        return read_kitti_calib(path, width_px, height_px, GREY_CAMERAS if grey else COLOUR_CAMERAS)
    if _HOMOGRAPHIES.search(text):
        raise CalibrationError(
            "homographies know no focal length and no baseline: there is no depth in them",
            where=path,
            hint="recon disparity takes the rectified images as they are; for depth use a "
            "calibration of the cameras (recon calibrate)",
        )
    raise FormatError(
        "not a calibration file",
        where=path,
        expected="our YAML, KITTI calib.txt (P0: …), Middlebury calib.txt (cam0=…), "
        "OpenCV YAML/XML (M1 …), ROS CameraInfo or a kalibr camchain (cam0: …)",
    )
