"""KITTI's calibrations; ``calib_cam_to_cam.txt`` has four cameras, each raw and rectified."""

from __future__ import annotations

import re
from typing import Final

from recon.core.geometry.se3 import invert, make_transform
from recon.core.values import CameraIntrinsics, RectifiedCamera, StereoCalibration, other_size
from recon.core.values.arrays import Float64
from recon.io.cameras.kitti import read_kitti_calib
from recon.io.fields import Fields
from recon.io.files import StrPath, read_text, reader

_LINE: Final = re.compile(r"^([A-Z](?:_rect)?_\d\d):(.*)$", re.MULTILINE)


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
    fields = Fields(dict(_LINE.findall(read_text(path))), path)
    if f"S_rect_{cameras[0]:02d}" not in fields:
        return read_kitti_calib(path, width_px, height_px, cameras)
    recorded, rectified = (
        tuple(int(n) for n in fields.numbers(f"{key}_{cameras[0]:02d}", (2,)))
        for key in ("S", "S_rect")
    )
    if (width_px, height_px) == rectified:
        return read_kitti_calib(path, width_px, height_px, cameras)
    if (width_px, height_px) != recorded:
        expected = f"{rectified[0]}x{rectified[1]} rectified, or {recorded[0]}x{recorded[1]} raw"
        raise other_size(width_px, height_px, expected, path)
    T_left_0, T_right_0 = (_pose(fields, camera) for camera in cameras)
    left, right = (_camera(fields, camera, recorded) for camera in cameras)
    return StereoCalibration(left, right, T_right_0 @ invert(T_left_0))


def _camera(fields: Fields, camera: int, size: tuple[int, ...]) -> CameraIntrinsics:
    matrix = fields.numbers(f"K_{camera:02d}", (3, 3))
    return CameraIntrinsics(matrix, fields.numbers(f"D_{camera:02d}", (5,)), size[0], size[1])


def _pose(fields: Fields, camera: int) -> Float64:
    """Return ``T_camera_camera0``."""
    rotation = fields.numbers(f"R_{camera:02d}", (3, 3))
    return make_transform(rotation, fields.numbers(f"T_{camera:02d}", (3,)))
