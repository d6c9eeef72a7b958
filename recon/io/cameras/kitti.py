"""KITTI calibration: projection matrices ``P0`` … ``P3`` of the rectified cameras (``calib.txt``).

``calib_cam_to_cam.txt`` of a raw drive has four cameras, each raw and rectified.
"""

from __future__ import annotations

import re
from collections.abc import Mapping
from pathlib import Path
from typing import Final

import numpy as np

from recon.core.errors import CalibrationError, FormatError
from recon.core.geometry.se3 import invert, make_transform
from recon.core.values import (
    CameraIntrinsics,
    RectifiedCamera,
    Rig,
    StereoCalibration,
    check_rotation,
    check_side_by_side,
    check_unsized,
    other_size,
)
from recon.core.values.arrays import Float64
from recon.io.fields import Fields
from recon.io.files import StrPath, read_text, reader

GREY_CAMERAS: Final = (0, 1)
COLOUR_CAMERAS: Final = (2, 3)
_FOLDER: Final = re.compile(r"image_0?([0-3])")
_LINE: Final = re.compile(r"^P(?:_rect_0)?(\d):(.*)$", re.MULTILINE | re.ASCII)
_RAW_LINE: Final = re.compile(r"^([A-Z](?:_rect)?_\d\d):(.*)$", re.MULTILINE | re.ASCII)


@reader
def read_kitti_calib(
    path: StrPath, width_px: int, height_px: int, cameras: tuple[int, int] = GREY_CAMERAS
) -> RectifiedCamera:
    """Read the rectified camera of one stereo pair from either kind of file."""
    found = {f"P{camera}": _projection(path, camera) for camera in cameras}
    left = next(iter(found.values()))
    check_unsized((float(left[0, 2]), float(left[1, 2])), width_px, height_px, path)
    return projected_rig(found, width_px, height_px)


def projected_rig(
    projections: Mapping[str, Float64], width_px: int, height_px: int
) -> RectifiedCamera:
    """Return the rectified camera of two projection matrices (3, 4), left and right, by name."""
    left, right = projections.values()
    offsets_m = [offset_m(projection, name) for name, projection in projections.items()]
    if not np.allclose(left[:, :3][[0, 1, 1], [0, 1, 2]], right[:, :3][[0, 1, 1], [0, 1, 2]]):
        raise CalibrationError(
            f"{' and '.join(projections)} have different focal lengths or rows",
            hint="a rectified pair shares them; rectify the images first",
        )
    check_side_by_side(offsets_m[1] - offsets_m[0])
    baseline_m = float(offsets_m[0][0] - offsets_m[1][0])
    return RectifiedCamera.from_matrices(left, right, baseline_m, width_px, height_px)


@reader
def read_kitti_offset(path: StrPath, camera: int) -> Float64:
    """Return ``T_camera_camera0`` (4, 4), a translation: KITTI's trajectories are of camera 0."""
    T = np.eye(4)
    T[:3, 3] = offset_m(_projection(path, camera))
    return T


def kitti_cameras_of(left: Path) -> tuple[int, int] | None:
    """Return left and right camera, if the path of a left image names KITTI's folder of one."""
    for part in reversed(left.parts):
        found = _FOLDER.fullmatch(part)
        if found:
            return COLOUR_CAMERAS if int(found[1]) in COLOUR_CAMERAS else GREY_CAMERAS
    return None


@reader
def list_kitti_cameras(path: StrPath) -> frozenset[int]:
    """Return numbers of the cameras that have a matrix in a calibration file."""
    return frozenset(int(number) for number, _ in _LINE.findall(read_text(path)))


def _projection(path: StrPath, camera: int) -> Float64:
    rows = {int(number): row for number, row in _LINE.findall(read_text(path))}
    name = f"P{camera}"
    if camera not in rows:
        got = ", ".join(f"P{number}" for number in sorted(rows)) or "no projection matrix"
        hint = "a stereo pair needs P0 and P1, or P2 and P3"
        raise FormatError(f"calibration has no {name}", got=got, hint=hint)
    return Fields({name: rows[camera]}).numbers(name, (3, 4))


def offset_m(projection: Float64, name: str = "P") -> Float64:
    """Return ``t`` (3,) of ``P = K·[I | t]``: from the camera that all ``P`` of a rig measure from.

    That need not be the left one: both of KITTI's colour pair measure from the grey left camera.
    """
    if not np.allclose(projection[[1, 2, 2, 2], [0, 0, 1, 2]], [0, 0, 0, 1]):
        raise FormatError(f"{name} is not the projection matrix of a rectified camera")
    if min(projection[0, 0], projection[1, 1]) <= 0:
        got = f"{projection[0, 0]:g} px"
        raise CalibrationError(f"focal length of {name} is not positive", got=got)
    return np.asarray(np.linalg.solve(projection[:, :3], projection[:, 3]), dtype=np.float64)


@reader
def read_kitti_rig(path: StrPath, width_px: int, height_px: int, cameras: tuple[int, int]) -> Rig:
    """Read a stereo pair: rectified if the images have that size or there is none, else raw.

    Ref: Geiger et al., "Vision meets Robotics: The KITTI Dataset", IJRR 2013, section 4.
    """
    fields = Fields(dict(_RAW_LINE.findall(read_text(path))))
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
    left, right = (
        CameraIntrinsics(
            fields.numbers(f"K_{n:02d}", (3, 3)), fields.numbers(f"D_{n:02d}", (5,)), *recorded[:2]
        )
        for n in cameras
    )
    return StereoCalibration(left, right, T_right_0 @ invert(T_left_0))


def _pose(fields: Fields, camera: int) -> Float64:
    rotation = fields.numbers(f"R_{camera:02d}", (3, 3))
    check_rotation(rotation, f"R_{camera:02d}")
    return make_transform(rotation, fields.numbers(f"T_{camera:02d}", (3,)))
