"""KITTI's calibrations; ``calib_cam_to_cam.txt`` has four cameras, each raw and rectified."""

from __future__ import annotations

import re
from typing import Final

import numpy as np

from recon.core.errors import FormatError
from recon.core.geometry.se3 import invert, make_transform
from recon.core.values import CameraIntrinsics, RectifiedCamera, StereoCalibration, other_size
from recon.core.values.arrays import Float64
from recon.io.cameras.kitti import read_kitti_calib
from recon.io.files import StrPath, read_text, reader

_LINE: Final = re.compile(r"^([A-Z](?:_rect)?_\d\d):(.*)$", re.MULTILINE)
_SIZES: Final = {"S": 2, "K": 9, "D": 5, "R": 9, "T": 3, "S_rect": 2}


@reader
def read_kitti_rig(
    path: StrPath, width_px: int, height_px: int, cameras: tuple[int, int]
) -> RectifiedCamera | StereoCalibration:
    """Read the cameras of one stereo pair, rectified or raw according to the image size.

    Rectified images (``_sync`` drives) are smaller than raw ones (``_extract`` drives). A file
    without sizes is of rectified images.

    Args:
        path: ``calib_cam_to_cam.txt`` of a raw drive, or ``calib.txt`` of an odometry sequence.
        width_px: Image width.
        height_px: Image height.
        cameras: Left and right camera: (0, 1) grey, (2, 3) colour.

    Raises:
        FormatError: The file is missing or lacks a line.
        CalibrationError: The calibration cannot give depth, or the image size is neither of the
            two.

    Ref: Geiger et al., "Vision meets Robotics: The KITTI Dataset", IJRR 2013, section 4.
    """
    rows = dict(_LINE.findall(read_text(path)))
    if f"S_rect_{cameras[0]:02d}" not in rows:
        return read_kitti_calib(path, width_px, height_px, cameras)
    recorded, rectified = (
        tuple(int(n) for n in _numbers(rows, key, cameras[0], path)) for key in ("S", "S_rect")
    )
    if (width_px, height_px) == rectified:
        return read_kitti_calib(path, width_px, height_px, cameras)
    if (width_px, height_px) != recorded:
        expected = f"{rectified[0]}x{rectified[1]} rectified, or {recorded[0]}x{recorded[1]} raw"
        raise other_size(width_px, height_px, expected, path)
    T_left_0, T_right_0 = (_pose(rows, camera, path) for camera in cameras)
    left, right = (_camera(rows, camera, recorded, path) for camera in cameras)
    return StereoCalibration(left, right, T_right_0 @ invert(T_left_0))


def _camera(
    rows: dict[str, str], camera: int, size: tuple[int, ...], path: StrPath
) -> CameraIntrinsics:
    matrix = _numbers(rows, "K", camera, path).reshape(3, 3)
    return CameraIntrinsics(matrix, _numbers(rows, "D", camera, path), size[0], size[1])


def _pose(rows: dict[str, str], camera: int, path: StrPath) -> Float64:
    """Return ``T_camera_camera0``."""
    rotation = _numbers(rows, "R", camera, path).reshape(3, 3)
    return make_transform(rotation, _numbers(rows, "T", camera, path))


def _numbers(rows: dict[str, str], key: str, camera: int, path: StrPath) -> Float64:
    name = f"{key}_{camera:02d}"
    try:
        numbers = np.array([float(word) for word in rows[name].split()])
    except KeyError as error:
        raise FormatError(f"calibration has no {name}", where=path) from error
    except ValueError as error:
        raise FormatError(f"{name} has a value that is not a number", where=path) from error
    if len(numbers) != _SIZES[key] or not np.isfinite(numbers).all():
        raise FormatError(f"{name} is not {_SIZES[key]} finite numbers", where=path)
    return numbers
