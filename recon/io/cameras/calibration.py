"""Reads any supported calibration file, recognised by its content."""

from __future__ import annotations

import re
from collections.abc import Callable
from typing import Final
from zipfile import is_zipfile

from recon.core.errors import CalibrationError, FormatError
from recon.core.text import parse_number
from recon.core.values import (
    Rig,
    StereoCalibration,
    check_side_by_side,
    check_size,
)
from recon.io.cameras.kitti import COLOUR_CAMERAS, GREY_CAMERAS, list_kitti_cameras, read_kitti_rig
from recon.io.cameras.opencv_yaml import INSTEAD, read_opencv_calibration
from recon.io.cameras.recon_yaml import MARK, read_recon_calibration, write_recon_calibration
from recon.io.cameras.ros import in_options, read_camera_info, read_kalibr
from recon.io.files import SMALL_FILE_BYTES, StrPath, read_text, reader
from recon.io.middlebury import read_middlebury_calib

_COMMA, _POINT = re.compile(r"\d,\d"), re.compile(r"^[^%<\n]*\d\.", re.MULTILINE)
#: Numbers of rectified cameras in the settings of ORB-SLAM.
_ORB_SLAM: Final = re.compile(r"^(?:Camera1?|Stereo)\.(fx|cx|cy|bf|b):\s*(\S+)", re.MULTILINE)
#: What a file of each format contains. OpenCV's comes after the others that may have its header,
#: and before KITTI's: it may contain a ``P1:``.
_SIGNS: Final = {
    "recon": re.compile(rf"^format:\s*{MARK}", re.MULTILINE),
    "ros": re.compile(r"^projection_matrix:", re.MULTILINE),
    "kalibr": re.compile(r"^cam0:", re.MULTILINE),
    "opencv": re.compile(r"^%YAML|<opencv_storage>|opencv-matrix"),
    "middlebury": re.compile(r"^\s*cam[01]\s*=", re.MULTILINE),
    "kitti": re.compile(r"^P(?:_rect_0)?\d:", re.MULTILINE | re.ASCII),
    "homographies": re.compile(r"^H_left:", re.MULTILINE),
}
_READERS: Final[dict[str, Callable[[StrPath], Rig]]] = {
    "recon": read_recon_calibration,
    "kalibr": read_kalibr,
    "middlebury": lambda path: read_middlebury_calib(path).camera,
}


@reader
def read_calibration(
    path: StrPath,
    width_px: int | None = None,
    height_px: int | None = None,
    *,
    metres_per_unit: float = 1.0,
    cameras: tuple[int, int] | None = None,
) -> Rig:
    """Read the calibration of images of one size from a file of any supported format.

    Supported are our own YAML, KITTI's ``calib.txt`` and ``calib_cam_to_cam.txt`` (its rectified or
    raw ``cameras``, according to the image size; None = the grey pair if it has one), Middlebury's
    ``calib.txt``, OpenCV's ``FileStorage`` files (translation in so many ``metres_per_unit``), ROS
    CameraInfo (either of the two files; the other is expected in the same folder), and kalibr's
    camera chain. Rectified images give a `RectifiedCamera`.

    Raises:
        FormatError: The file is missing, damaged or of an unknown format, or it does not contain
            the image size (KITTI's and some of OpenCV's do not) and none is given.
        CalibrationError: The calibration cannot give depth, such as one with left and right
            swapped, or is of another image size.
    """
    size = None if width_px is None or height_px is None else (width_px, height_px)
    if is_zipfile(path):
        raise FormatError("arrays of NumPy are not a calibration file", hint=INSTEAD)
    text = read_text(path, SMALL_FILE_BYTES)
    if _COMMA.search(text) and not _POINT.search(text):
        raise FormatError("decimals are written with a comma", expected="a point, as 0.5")
    _refuse_numbers(text)
    form = next((form for form, sign in _SIGNS.items() if sign.search(text)), "")
    if form == "opencv":
        rig: Rig = read_opencv_calibration(path, size_px=size, metres_per_unit=metres_per_unit)
    elif form == "kitti":
        rig = _read_kitti(path, size, cameras)
    elif form == "ros":
        rig = read_camera_info(path, size)
    elif form in _READERS:
        rig = _READERS[form](path)
    elif form == "homographies":
        what = "homographies know no focal length and no baseline: there is no depth in them"
        use = "for depth use a calibration of the cameras (recon calibrate)"
        hint = f"recon disparity takes the rectified images as they are; {use}"
        raise CalibrationError(what, hint=hint)
    else:
        raise FormatError(
            "not a calibration file of a known kind",
            expected="our YAML, KITTI calib.txt (P0: …), Middlebury calib.txt (cam0=…), "
            "OpenCV YAML/XML/JSON (M1 …, or P1 P2), ROS CameraInfo or a kalibr camchain (cam0: …)",
            hint=INSTEAD,
        )
    if isinstance(rig, StereoCalibration):
        check_side_by_side(rig.T_right_left[:3, 3])
    if size is not None:
        check_size(rig, *size, path)
    return rig


def write_calibration(path: StrPath, calibration: Rig) -> None:
    """Write a calibration in our own YAML, atomically; `read_calibration` reads it back.

    Raises:
        CalibrationError: It cannot give depth, such as one with left and right swapped.
        OutputError: The file cannot be written.
    """
    if isinstance(calibration, StereoCalibration):
        check_side_by_side(calibration.T_right_left[:3, 3], path)
    write_recon_calibration(path, calibration)


def _refuse_numbers(text: str) -> None:
    """Refuse settings of ORB-SLAM, whose cameras are numbers that options take."""
    found = dict(_ORB_SLAM.findall(text))
    if {"fx", "cx", "cy"} < found.keys() and found.keys() & {"b", "bf"}:
        fx, cx, cy = (parse_number(found[name]) for name in ("fx", "cx", "cy"))
        baseline_m = parse_number(found["b"]) if "b" in found else parse_number(found["bf"]) / fx
        what = "not a calibration of raw cameras, but numbers of rectified ones"
        given = f"if the images are rectified give {in_options(fx, baseline_m, cx, cy)}"
        raise FormatError(what, hint=f"{given}; else calibrate both cameras as a pair")


def _read_kitti(
    path: StrPath, size: tuple[int, int] | None, cameras: tuple[int, int] | None
) -> Rig:
    if size is None:
        what = "a KITTI calibration does not say which images it is of"
        those = "recon.reconstruct or recon.match, which take the size from the images"
        raise FormatError(what, hint=f"pass width_px and height_px, or give the file to {those}")
    known = list_kitti_cameras(path)
    grey = known.issuperset(GREY_CAMERAS) or not known.issuperset(COLOUR_CAMERAS)
    return read_kitti_rig(path, *size, cameras or (GREY_CAMERAS if grey else COLOUR_CAMERAS))
