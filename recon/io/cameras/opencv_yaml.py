"""OpenCV's stereo calibration: YAML, XML or JSON as written by ``cv2.FileStorage``."""

from __future__ import annotations

import json
import re
import xml.etree.ElementTree as ET
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any, Final

import cv2
import numpy as np

from recon.core.errors import CalibrationError, FormatError
from recon.core.geometry.se3 import make_transform
from recon.core.text import counted
from recon.core.values import (
    CameraIntrinsics,
    LensModel,
    RectifiedCamera,
    Rig,
    StereoCalibration,
    check_unsized,
)
from recon.core.values.arrays import Float64
from recon.io.atomic import write_text
from recon.io.cameras.kitti import projected_rig
from recon.io.fields import numbers_of, parse_yaml, plain_yaml
from recon.io.files import SMALL_FILE_BYTES, StrPath, read_text, reader, reading

# Accepted names: those of OpenCV's samples first, then those of calibration tools and tutorials.
_MATRICES: Final = (
    ("M1", "K1", "cameraMatrix1", "camera_matrix_left", "cameraMatrixL"),
    ("M2", "K2", "cameraMatrix2", "camera_matrix_right", "cameraMatrixR"),
)
_DISTORTIONS: Final = (
    ("D1", "distCoeffs1", "dist_coeffs_left", "distCoeffsL"),
    ("D2", "distCoeffs2", "dist_coeffs_right", "distCoeffsR"),
)
_PROJECTIONS: Final = frozenset({"P1", "P2"})  # of rectified cameras
_ROTATION: Final = ("R", "rotation_matrix")
_TRANSLATION: Final = ("T", "translation_vector")
_SIZE: Final = ("image_size", "imageSize", "img_size")
_WIDTH: Final = ("image_width", "imageWidth", "width")
_HEIGHT: Final = ("image_height", "imageHeight", "height")
_MODEL: Final = ("distortion_model", "camera_model", "model")
_FISHEYE_NAMES: Final = frozenset({"fisheye", "equidistant", "kannala-brandt", "kannalabrandt8"})
# OpenCV names no lens model, and both have four coefficients. A pinhole that sees more than 90
# degrees has a distortion above this; a fisheye's polynomial is close to 1.
_FISHEYE_LIKE: Final = 0.1
_DISTORTION_COUNTS: Final = frozenset({0, 4, 5, 8, 12, 14})  # coefficients that OpenCV supports
_LONGEST_BASELINE_M: Final = 20.0  # longer than any rig: millimetres read as metres
INSTEAD: Final = (
    "write M1, D1, M2, D2, R, T, image_width and image_height into one file with OpenCV's "
    "FileStorage; of rectified images --focal PX and --baseline M are enough"
)
"""What to do with a calibration that is not read."""
_NOT_FINITE: Final = re.compile(r"\.(?:Nan|Inf)\b")
_XML_ROOT: Final = "opencv_storage"
Nodes = dict[str, Float64 | str]


@reader
def read_opencv_calibration(
    path: StrPath, *, size_px: tuple[int, int] | None = None, metres_per_unit: float | None = None
) -> Rig:
    """Read two raw cameras (``M1 D1 M2 D2``, or ``cameraMatrix1`` …) and their pose (``R T``).

    Of OpenCV's pair of files, ``intrinsics`` without ``R``, the ``extrinsics`` beside are read,
    too. A file of ``P1`` and ``P2`` alone is of rectified images. ``size_px`` (width, height) is
    for files that do not state it; ``metres_per_unit`` is the unit of ``T``; None = metres,
    of a baseline that a rig may have.
    """
    nodes = read_file_storage(path)
    stated = _size(nodes)
    size = stated or size_px
    if size is None:
        raise FormatError(
            "calibration does not contain the image size",
            expected="image_width and image_height",
            hint="from Python: pass width_px and height_px, or give the file itself to "
            "recon.reconstruct or recon.match, which take the size from the images",
        )
    # With a pose of raw cameras, they are of what those become, not of the images.
    raw = any(_find(nodes, names) is not None for names in (_MATRICES[0], _ROTATION))
    if not raw and nodes.keys() >= _PROJECTIONS:
        return _rectified(nodes, size, metres_per_unit, path if stated is None else None)
    model = _model(nodes)
    lens: LensModel = model or "pinhole"
    left, right = (_camera(nodes, side, size, lens) for side in (0, 1))
    if model is None:  # the lenses may as well be fisheyes
        for camera in (left, right):
            wide = camera.width_px / 2 > camera.matrix[0, 0]
            largest = np.abs(camera.distortion).max(initial=0.0)
            if camera.distortion.size == 4 and wide and 0 < largest < _FISHEYE_LIKE:
                raise FormatError(
                    "calibration does not say which lens model its four coefficients belong to",
                    expected="a line 'distortion_model: fisheye', or 'distortion_model: pinhole'",
                )
    if stated is None:
        check_unsized((left.matrix[0, 2], left.matrix[1, 2]), *size, path)
    beside = Path(path).with_name(Path(path).name.replace("intrinsics", "extrinsics"))
    outer = beside if _find(nodes, _ROTATION) is None and beside.is_file() else path
    with reading(outer):
        outer_nodes = read_file_storage(outer)
        rotation = _matrix(outer_nodes, _ROTATION, (3, 3))
        translation_m = _matrix(outer_nodes, _TRANSLATION, (3,)) * (metres_per_unit or 1.0)
        calibration = StereoCalibration(left, right, make_transform(rotation, translation_m))
        _check_unit(calibration.baseline_m, metres_per_unit)
    return calibration


def _rectified(
    nodes: Nodes, size: tuple[int, int], metres_per_unit: float | None, unsized: StrPath | None
) -> RectifiedCamera:
    found = {name: _matrix(nodes, (name,), (3, 4)).copy() for name in sorted(_PROJECTIONS)}
    for matrix in found.values():
        matrix[:, 3] *= metres_per_unit or 1.0
    if unsized is not None:
        check_unsized((found["P1"][0, 2], found["P1"][1, 2]), *size, unsized)
    camera = projected_rig(found, *size)
    _check_unit(camera.baseline_m, metres_per_unit)
    return camera


def _check_unit(baseline_m: float, metres_per_unit: float | None) -> None:
    if metres_per_unit is None and baseline_m > _LONGEST_BASELINE_M:
        what = "baseline is implausibly long"
        got, expected = f"{baseline_m:g} m", f"at most {_LONGEST_BASELINE_M:g} m"
        hint = "in millimetres? --set source.metres_per_unit=0.001 (1 if it is right), in Python "
        hint += "metres_per_unit=0.001"
        raise CalibrationError(what, got=got, expected=expected, hint=hint)


def write_opencv_calibration(path: StrPath, calibration: StereoCalibration) -> None:
    """Write one file for OpenCV's ``FileStorage``: XML or JSON where it is named so, else YAML."""
    models = {calibration.left.model, calibration.right.model}
    if len(models) > 1:
        raise CalibrationError("an OpenCV file cannot store two lens models", where=path)
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


def _model(nodes: Nodes) -> LensModel | None:
    named = {str(nodes[name]).lower() for name in _MODEL if name in nodes}
    if not named:
        return None
    return "fisheye" if named & _FISHEYE_NAMES else "pinhole"


def _find(nodes: Nodes, names: Sequence[str]) -> Float64 | None:
    """Return the numbers under the first of some names that has any."""
    found = (nodes.get(name) for name in names)
    return next((value for value in found if isinstance(value, np.ndarray)), None)


def _matrix(nodes: Nodes, names: Sequence[str], shape: tuple[int, ...]) -> Float64:
    value, what = _find(nodes, names), repr(names[0])
    if value is None:
        got, expected = ", ".join(nodes) or "nothing", " or ".join(names)
        raise FormatError(f"calibration has no {what}", got=got, expected=expected, hint=INSTEAD)
    if value.size != np.prod(shape):
        raise FormatError(f"{what} has the wrong size", got=value.shape, expected=shape)
    return value.reshape(shape)


def _camera(nodes: Nodes, side: int, size: tuple[int, int], model: LensModel) -> CameraIntrinsics:
    matrix = _matrix(nodes, _MATRICES[side], (3, 3))
    found = _find(nodes, _DISTORTIONS[side])
    distortion = np.zeros(0) if found is None else found.ravel()
    if distortion.size not in _DISTORTION_COUNTS:
        what, got = repr(_DISTORTIONS[side][0]), counted(distortion.size, "coefficient")
        raise FormatError(f"{what} has the wrong size", got=got, expected="4, 5, 8, 12 or 14")
    return CameraIntrinsics(matrix, distortion, *size, model)


def _size(nodes: Nodes) -> tuple[int, int] | None:
    width, height, both = (_find(nodes, names) for names in (_WIDTH, _HEIGHT, _SIZE))
    if width is not None and height is not None:
        return int(width), int(height)
    if both is not None and both.size == 2:
        return int(both.ravel()[0]), int(both.ravel()[1])
    return None


@reader
def read_file_storage(path: StrPath) -> Nodes:
    """Read the top level: texts, and numbers as float64 () or (N,), matrices row by row."""
    # OpenCV's own parser overflows its stack, does not end, or allocates what a matrix claims.
    text = read_text(path, SMALL_FILE_BYTES)
    try:
        nodes = _parse(text, path)
    except (ET.ParseError, json.JSONDecodeError) as error:
        raise FormatError("not an OpenCV FileStorage file", got=error) from error
    if not isinstance(nodes, dict):
        raise FormatError("not an OpenCV FileStorage file")
    values = {str(name): _value(node) for name, node in nodes.items()}
    return {name: value for name, value in values.items() if value is not None}


def _parse(text: str, path: StrPath) -> Any:
    start = text.lstrip()[:1]
    if start == "<":
        root = ET.fromstring(text.encode())  # noqa: S314 - see the import
        return {node.tag: _xml_node(node) for node in root} if root.tag == _XML_ROOT else None
    if start == "{":
        return json.loads(text)
    # OpenCV capitalises only the first letter of .Nan and .Inf.
    plain = _NOT_FINITE.sub(lambda found: found[0].lower(), plain_yaml(text))
    return parse_yaml(plain, path)


def _xml_node(element: ET.Element) -> Any:
    data = element.find("data")
    if data is not None:
        return {"data": (data.text or "").split()}
    words = (element.text or "").split()
    return words if len(words) > 1 else "".join(words).strip('"')


def _value(node: Any) -> Float64 | str | None:
    """Return a number, the numbers of a list or matrix, or a text; None for anything else."""
    if isinstance(node, Mapping):
        return _value(node["data"]) if isinstance(node.get("data"), list) else None
    if isinstance(node, list) and any(isinstance(part, list | dict) for part in node):
        return None
    try:
        return numbers_of(node)
    except ValueError:
        return node if isinstance(node, str) else None
