"""ROS CameraInfo as YAML: one file per camera."""

from __future__ import annotations

import re
from pathlib import Path
from typing import Any, Final

import numpy as np
import yaml
from numpy.typing import NDArray

from recon.core.errors import CalibrationError, FormatError
from recon.core.geometry.se3 import make_transform, orthonormalise
from recon.core.values import CameraIntrinsics, RectifiedCamera, StereoCalibration
from recon.core.values.arrays import Float64
from recon.io.atomic import write_text
from recon.io.cameras.lens_models import ROS_MODELS, lens_of, name_lens
from recon.io.fields import Fields
from recon.io.files import StrPath, reader, reading
from recon.io.yaml_file import read_yaml

_SIDES: Final = ("left", "right")


def camera_info_paths(path: StrPath) -> tuple[Path, Path]:
    """Return both paths: ``left`` or ``right`` in the name is swapped, or added."""
    given = Path(path)
    for side in _SIDES:
        if re.search(side, given.stem):
            names = [re.sub(side, other, given.stem) + given.suffix for other in _SIDES]
            return given.with_name(names[0]), given.with_name(names[1])
    names = [f"{given.stem}_{side}{given.suffix}" for side in _SIDES]
    return given.with_name(names[0]), given.with_name(names[1])


@reader
def read_camera_info(path: StrPath) -> StereoCalibration:
    """Read a rig from either of its two files; the other is found by its name.

    The pose of the right camera follows from the two rectifying rotations and
    ``P[0, 3] = -fx · baseline``.
    """
    left_path, right_path = camera_info_paths(path)
    if not (left_path.is_file() and right_path.is_file()):
        missing = right_path if left_path.is_file() else left_path
        raise FormatError(
            "CameraInfo of the other camera is missing",
            where=missing,
            hint="give both files the same name but for 'left' and 'right'",
        )
    left, R_left, _ = _read_one(left_path)
    right, R_right, P_right = _read_one(right_path)
    return rig_of_camera_infos((left, R_left), (right, R_right), P_right, right_path)


def rig_of_camera_infos(
    left: tuple[CameraIntrinsics, Float64],
    right: tuple[CameraIntrinsics, Float64],
    P_right: Float64,
    where: StrPath,
) -> StereoCalibration:
    """Return the rig described by two CameraInfos, from files or messages.

    Args:
        left: The left camera and its rectifying rotation, float64 (3, 3).
        right: The right camera, likewise.
        P_right: float64 (3, 4), projection matrix of the rectified right camera.
        where: File or topic, for error messages.
    """
    check_shift(P_right, 0.0, where)
    offset = np.array([P_right[0, 3] / P_right[0, 0], 0.0, 0.0])
    with reading(where):
        T = orthonormalise(make_transform(right[1].T @ left[1], right[1].T @ offset))
        return StereoCalibration(left[0], right[0], T)


def check_shift(P_right: Float64, left_shift: float, where: StrPath) -> None:
    """Check that the projection matrix of the right camera contains a baseline.

    Args:
        P_right: float64 (3, 4).
        left_shift: ``P[0, 3]`` of the left camera, usually 0.
        where: File or topic, for the error message.
    """
    shift = float(P_right[0, 3]) - left_shift
    if shift < 0:
        return
    got, expected = f"P[0, 3] = {P_right[0, 3]:g}", "-fx * baseline, below 0"
    if shift > 0:
        raise CalibrationError(
            "right camera is to the left of the left camera",
            where=where,
            got=got,
            expected=expected,
            hint="swap left and right",
        )
    raise CalibrationError(
        "CameraInfo has no baseline",
        where=where,
        got=got,
        expected=expected,
        hint="the right camera was calibrated alone: calibrate both as a pair, or name a "
        "calibration file with --calib",
    )


def write_camera_info(
    path: StrPath,
    calibration: StereoCalibration,
    rotations: tuple[Float64, Float64],
    rectified: RectifiedCamera,
) -> tuple[Path, Path]:
    """Write the two files of a rig, each atomically.

    Args:
        path: See `camera_info_paths`.
        calibration: The raw cameras.
        rotations: float64 (3, 3) per camera, from its raw axes to the rectified axes.
        rectified: The rectified camera.

    Returns:
        The two files.
    """
    paths = camera_info_paths(path)
    cameras = (calibration.left, calibration.right)
    shifts = (0.0, -rectified.focal_px * rectified.baseline_m)
    texts = []
    for side, camera, rotation, shift in zip(_SIDES, cameras, rotations, shifts, strict=True):
        P = np.hstack([rectified.matrix, [[shift], [0.0], [0.0]]])
        P[0, 2] = rectified.cx_right_px if side == "right" else rectified.cx_px
        texts.append(_text(side, camera, rotation, P))
    for target, text in zip(paths, texts, strict=True):
        write_text(target, text)
    return paths


def _text(side: str, camera: CameraIntrinsics, rotation: Float64, P: Float64) -> str:
    name, coefficients = name_lens(ROS_MODELS, camera, "ROS CameraInfo")
    content = {
        "image_width": camera.width_px,
        "image_height": camera.height_px,
        "camera_name": side,
        "camera_matrix": _matrix(camera.matrix),
        "distortion_model": name,
        "distortion_coefficients": _matrix(coefficients.reshape(1, -1)),
        "rectification_matrix": _matrix(rotation),
        "projection_matrix": _matrix(P),
    }
    return yaml.safe_dump(content, sort_keys=False, default_flow_style=None)


def _matrix(values: NDArray[Any]) -> dict[str, Any]:
    rows, columns = values.shape
    return {"rows": rows, "cols": columns, "data": values.ravel().tolist()}


@reader
def _read_one(path: Path) -> tuple[CameraIntrinsics, Float64, Float64]:
    """Read a camera, its rectifying rotation (3, 3) and its projection matrix (3, 4)."""
    fields = Fields(read_yaml(path), path)
    data = {
        name: fields.below(name)
        for name in ("camera_matrix", "distortion_coefficients", "rectification_matrix")
    }
    model, distortion = lens_of(
        ROS_MODELS,
        fields.text("distortion_model"),
        data["distortion_coefficients"].numbers("data"),
        path,
    )
    camera = CameraIntrinsics(
        data["camera_matrix"].numbers("data", (3, 3)),
        distortion,
        fields.count("image_width"),
        fields.count("image_height"),
        model,
    )
    rotation = data["rectification_matrix"].numbers("data", (3, 3))
    return camera, rotation, fields.below("projection_matrix").numbers("data", (3, 4))
