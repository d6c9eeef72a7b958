"""Calibration files: our own YAML, and those of other programs, recognised by their content."""

from __future__ import annotations

import re
from collections.abc import Callable, Mapping
from pathlib import Path
from typing import Any, Final, cast

import cv2
import numpy as np
import yaml

from recon.core.errors import CalibrationError, FormatError
from recon.core.geometry.se3 import make_transform
from recon.core.values import (
    LENS_COEFFICIENTS,
    CameraIntrinsics,
    LensModel,
    RectifiedCamera,
    Rig,
    StereoCalibration,
    check_side_by_side,
    check_size,
)
from recon.io.atomic import write_text
from recon.io.cameras.contents import BINARY
from recon.io.cameras.kitti import COLOUR_CAMERAS, GREY_CAMERAS, list_kitti_cameras, read_kitti_rig
from recon.io.cameras.named import INSTEAD, read_named
from recon.io.cameras.ros import pinhole_matrix
from recon.io.fields import Fields, read_yaml
from recon.io.files import SMALL_FILE_BYTES, StrPath, read_text, reader
from recon.io.middlebury import read_middlebury_calib

MARK: Final = "recon-calibration"
_VERSION: Final = 1
_HEADER: Final = """\
# Pixel centres are at integers; camera axes: x right, y down, z forward.
# xyz_right = rotation * xyz_left + translation_m
"""
_RECTIFIED: Final = ("focal_px", "cx_px", "cy_px", "cx_right_px", "baseline_m")


def write_recon_calibration(
    path: StrPath, calibration: Rig, quality: Mapping[str, Any] | None = None
) -> None:
    """Write a calibration atomically; figures of its ``quality`` are not read back."""
    content = {"format": MARK, "version": _VERSION, **_content(calibration)}
    if quality:
        content["quality"] = dict(quality)
    text = yaml.safe_dump(content, sort_keys=False, allow_unicode=True, default_flow_style=None)
    write_text(path, _HEADER + text)


def write_opencv_calibration(path: StrPath, calibration: StereoCalibration) -> None:
    """Write one file for OpenCV's ``FileStorage``: XML or JSON where it is named so, else YAML."""
    models = {calibration.left.model, calibration.right.model}
    if len(models) > 1:
        raise CalibrationError("an OpenCV file cannot store two lens models", where=path)
    if models - {"pinhole", "fisheye"}:
        what = "an OpenCV file cannot store this lens model"
        raise CalibrationError(what, where=path, got=calibration.left.model)
    suffix = Path(path).suffix.lower()
    kind = suffix if suffix in {".xml", ".json"} else ".yml"
    storage = cv2.FileStorage(kind, cv2.FILE_STORAGE_WRITE | cv2.FILE_STORAGE_MEMORY)
    storage.write("image_width", calibration.left.width_px)
    storage.write("image_height", calibration.left.height_px)
    if "fisheye" in models:
        storage.write("distortion_model", "fisheye")
    for number, camera in enumerate((calibration.left, calibration.right), start=1):
        storage.write(f"M{number}", np.array(camera.matrix))
        storage.write(f"D{number}", np.array(camera.distortion).reshape(1, -1))
    storage.write("R", np.array(calibration.T_right_left[:3, :3]))
    storage.write("T", np.array(calibration.T_right_left[:3, 3]).reshape(3, 1))
    write_text(path, storage.releaseAndGetString())


@reader
def read_recon_calibration(path: StrPath) -> Rig:
    """Read what `write_recon_calibration` wrote."""
    fields = Fields(read_yaml(path))
    if fields.text("format") != MARK or fields.number("version") != _VERSION:
        got, expected = f"{fields.get('format')} {fields.get('version')}", f"{MARK} {_VERSION}"
        what = "version of the calibration file is not supported"
        raise FormatError(what, got=got, expected=expected)
    kind = fields.text("kind")
    if kind == "rectified":
        camera = fields.below("camera")
        return RectifiedCamera(
            **{name: camera.number(name) for name in _RECTIFIED},
            width_px=camera.count("width_px"),
            height_px=camera.count("height_px"),
            ndisp=camera.count("ndisp") if "ndisp" in camera else None,
        )
    if kind != "stereo":
        raise FormatError("unknown kind of calibration", got=kind, expected="stereo or rectified")
    pose = fields.below("right_from_left")
    T = make_transform(pose.numbers("rotation", (3, 3)), pose.numbers("translation_m", (3,)))
    left, right = (_read_camera(fields.below(side)) for side in ("left", "right"))
    return StereoCalibration(left, right, T)


def _content(calibration: Rig) -> dict[str, Any]:
    if isinstance(calibration, RectifiedCamera):
        numbers = {name: float(getattr(calibration, name)) for name in _RECTIFIED}
        size = {"width_px": calibration.width_px, "height_px": calibration.height_px}
        searched = {} if calibration.ndisp is None else {"ndisp": calibration.ndisp}
        return {"kind": "rectified", "camera": {**size, **numbers, **searched}}
    T = calibration.T_right_left
    return {
        "kind": "stereo",
        "left": _camera_content(calibration.left),
        "right": _camera_content(calibration.right),
        "right_from_left": {"rotation": T[:3, :3].tolist(), "translation_m": T[:3, 3].tolist()},
    }


def _camera_content(camera: CameraIntrinsics) -> dict[str, Any]:
    K = camera.matrix
    pinhole = {"fx_px": K[0, 0], "fy_px": K[1, 1], "cx_px": K[0, 2], "cy_px": K[1, 2]}
    return {
        "model": camera.model,
        "width_px": camera.width_px,
        "height_px": camera.height_px,
        **{name: float(value) for name, value in pinhole.items()},
        "distortion": dict(
            zip(LENS_COEFFICIENTS[camera.model], camera.distortion.tolist(), strict=False)
        ),
    }


def _read_camera(fields: Fields) -> CameraIntrinsics:
    model = cast("LensModel", fields.text("model"))
    if model not in LENS_COEFFICIENTS:
        raise FormatError("unknown lens model", got=model, expected=", ".join(LENS_COEFFICIENTS))
    fx, fy, cx, cy = (fields.number(name) for name in ("fx_px", "fy_px", "cx_px", "cy_px"))
    given, names = fields.below("distortion"), LENS_COEFFICIENTS[model]
    known = [name for name in names if name in given]
    if known != list(names[: len(known)]):
        raise FormatError("distortion has gaps", got=", ".join(known), expected=", ".join(names))
    distortion = np.array([given.number(name) for name in known], dtype=np.float64)
    size = fields.count("width_px"), fields.count("height_px")
    return CameraIntrinsics(pinhole_matrix(fx, fy, cx, cy), distortion, *size, model)


_COMMA = re.compile(r"\d,\d")
_POINT = re.compile(r"^[^%<\n]*\d(?:\.|,\d+,\d)", re.MULTILINE)  # or a list of whole numbers
#: What a text of a format contains that has other rules than names and shapes. Files of OpenCV may
#: contain a ``P1:``, too: KITTI's comes after them.
_SIGNS: Final = {
    "recon": re.compile(rf"^format:\s*{MARK}", re.MULTILINE),
    "": re.compile(r"^%YAML|<opencv_storage>|opencv-matrix"),
    "middlebury": re.compile(r"^\s*cam[01]\s*=", re.MULTILINE),
    "kitti": re.compile(r"^P(?:_rect_0)?\d:", re.MULTILINE | re.ASCII),
    "homographies": re.compile(r"^H_left:", re.MULTILINE),
}
_READERS: Final[dict[str, Callable[[StrPath], Rig]]] = {
    "recon": read_recon_calibration,
    "middlebury": lambda path: read_middlebury_calib(path).camera,
}


@reader
def read_calibration(
    path: StrPath,
    width_px: int | None = None,
    height_px: int | None = None,
    *,
    metres_per_unit: float | None = None,
    cameras: tuple[int, int] | None = None,
) -> Rig:
    """Read the calibration of images of one size from a file of any supported format.

    Supported are our own YAML, KITTI's ``calib.txt`` and ``calib_cam_to_cam.txt`` (its rectified or
    raw ``cameras``, by the image size; None = the grey pair if it has one), Middlebury's
    ``calib.txt``, OpenCV's ``FileStorage`` files (translation in so many ``metres_per_unit``), ROS
    CameraInfo (one of two files in a folder), and kalibr's camera chain. Rectified images give a
    `RectifiedCamera`.

    Raises:
        FormatError: The file is missing, damaged or of an unknown format, or no image size is
            known.
        CalibrationError: It cannot give depth, or is of another image size.
    """
    size = None if width_px is None or height_px is None else (width_px, height_px)
    form = _form(path)
    if form == "kitti":
        rig: Rig | None = _read_kitti(path, size, cameras)
    elif form in _READERS:
        rig = _READERS[form](path)
    else:
        rig = read_named(path, size, metres_per_unit=metres_per_unit)
    if rig is None:
        raise FormatError(
            "not a calibration file of a known kind",
            expected="our YAML, KITTI calib.txt (P0: …), Middlebury calib.txt (cam0=…), OpenCV "
            "YAML/XML/JSON or arrays of NumPy (K1 …, or P1 P2), MATLAB .mat, ROS CameraInfo, a "
            "kalibr camchain (cam0: …), a ZED's .conf, settings of ORB-SLAM or VINS",
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


def _form(path: StrPath) -> str:
    """Return the name of a format that has a sign of its own; the others are known by names."""
    with Path(path).open("rb") as file:
        if b"\0" in file.read(128) or Path(path).suffix in BINARY:
            return ""
    text = read_text(path, SMALL_FILE_BYTES)
    if _COMMA.search(text) and not _POINT.search(text):
        raise FormatError("decimals are written with a comma", expected="a point, as 0.5")
    form = next((form for form, sign in _SIGNS.items() if sign.search(text)), "")
    if form == "homographies":
        what = "homographies know no focal length and no baseline: there is no depth in them"
        use = "for depth use a calibration of the cameras (recon calibrate)"
        hint = f"recon disparity takes the rectified images as they are; {use}"
        raise CalibrationError(what, hint=hint)
    return form


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
