"""Calibrations around ROS: CameraInfo (a YAML file per camera), kalibr's chains, EuRoC's sensors.

They name lens models alike, with numbers of coefficients of their own.
"""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
from typing import Any, Final

import numpy as np
import yaml
from numpy.typing import NDArray

from recon.core.errors import CalibrationError
from recon.core.geometry.se3 import make_transform, orthonormalise, rotation_from_quaternion
from recon.core.text import counted
from recon.core.values import (
    CameraIntrinsics,
    LensModel,
    RectifiedCamera,
    StereoCalibration,
    Trajectory,
    check_rotation,
    check_side_by_side,
)
from recon.core.values.arrays import Float64
from recon.io.atomic import write_text
from recon.io.cameras.kitti import offset_m
from recon.io.files import StrPath, read_table, reader, reading

# Name -> our model and the permitted numbers of coefficients; a writer uses the first that fits.
Models = Mapping[str, tuple[LensModel, tuple[int, ...]]]

ROS_MODELS: Final[Models] = {
    "plumb_bob": ("pinhole", (5, 4, 0)),
    "rational_polynomial": ("pinhole", (8, 12, 14)),
    "equidistant": ("fisheye", (4,)),
    "fisheye": ("fisheye", (4,)),
}
_KALIBR_MODELS: Final[Models] = {
    "radtan": ("pinhole", (4,)),
    "equidistant": ("fisheye", (4,)),
    "none": ("pinhole", (0,)),
}
NS: Final = 1e-9
_SIDES: Final = ("left", "right")
_OFF_CENTRE: Final = 0.05  # of a principal point, in image sizes: hardly a lens is mounted worse


def camera_info_paths(path: StrPath) -> tuple[Path, Path]:
    """Return both paths: ``left`` or ``right`` in the name is swapped, or added."""
    given = Path(path)
    found = next((side for side in _SIDES if side in given.stem), None)
    stems = [
        given.stem.replace(found, side) if found else f"{given.stem}_{side}" for side in _SIDES
    ]
    left, right = (given.with_name(stem + given.suffix) for stem in stems)
    return left, right


def rig_of_camera_infos(
    left: tuple[CameraIntrinsics, Float64],
    right: tuple[CameraIntrinsics, Float64],
    projections: tuple[Float64, Float64],
    where: StrPath,
    size: tuple[int, int] | None = None,
) -> StereoCalibration:
    """Return the rig of cameras, their rectifying rotations (3, 3) and both ``P`` (3, 4).

    Images of a ``size`` (width, height) that ``P`` is of, and ``K`` is not, are refused.
    """
    step_m = step_between(projections, where)
    stated = left[0].width_px, left[0].height_px
    if size and are_rectified((left[0].matrix, right[0].matrix), projections, stated, size):
        focal, cx, cy = projections[0][[0, 0, 1], [0, 2, 2]]
        raise CalibrationError(
            "the images are rectified: K and D of the CameraInfo are of others, and P is of them",
            got=f"images of {size[0]}x{size[1]} pixels",
            hint=f"instead of the file give {in_options(focal, -step_m[0], cx, cy)}",
        )
    with reading(where):
        for side, (_, rotation) in zip(_SIDES, (left, right), strict=True):
            check_rotation(rotation, f"rectification matrix R of the {side} CameraInfo")
        T = orthonormalise(make_transform(right[1].T @ left[1], right[1].T @ step_m))
        return StereoCalibration(left[0], right[0], T)


def are_rectified(
    matrices: tuple[Float64, Float64],
    projections: tuple[Float64, Float64],
    stated: tuple[int, int],
    size: tuple[int, int],
) -> bool:
    """Return whether images of a size (width, height) are what both ``P`` are of, and no ``K``.

    Rectified images may come with ``K`` and ``D`` of larger raw ones, as kitti2bag writes them,
    under the ``stated`` size (0 = none) of either.
    """

    def off(both: tuple[Float64, Float64], of: tuple[int, int]) -> float:
        # Of both cameras together: that turned ones see to the sides is no other size.
        centres = [(matrix[:2, 2] + 0.5) / of - 0.5 for matrix in both]
        return float(np.abs(np.mean(centres, axis=0)).max())

    if 0 in stated or stated == size:
        return off(matrices, size) > max(_OFF_CENTRE, 2 * off(projections, size))
    return off(matrices, stated) < off(matrices, size) and (
        off(projections, size) < off(projections, stated)
    )


def step_between(projections: tuple[Float64, Float64], where: StrPath) -> Float64:
    """Return ``xyz_right - xyz_left`` (3,) of a point, rectified axes, by both ``P`` (3, 4)."""
    with reading(where):
        left_m, right_m = map(offset_m, projections, (f"P of the {side}" for side in _SIDES))
    step_m: Float64 = right_m - left_m
    if step_m.any():
        check_side_by_side(step_m, where)
        return step_m
    left, right = (P[0, 3] for P in projections)
    raise CalibrationError(
        "CameraInfo has no baseline",
        where=where,
        got=f"P[0, 3] = {right:g}" + (f", {left:g} of the left" if left else ""),
        expected="-fx * baseline, below that of the left",
        hint="the right camera was calibrated alone, and no static transform is between both: "
        "calibrate both as a pair, or name a calibration file with --calib",
    )


def write_camera_info(
    path: StrPath,
    calibration: StereoCalibration,
    rotations: tuple[Float64, Float64],
    rectified: RectifiedCamera,
) -> tuple[Path, Path]:
    """Write both files of a rig, each atomically; rotations (3, 3) lead to rectified axes."""
    paths = camera_info_paths(path)
    cameras = (calibration.left, calibration.right)
    shifts = (0.0, -rectified.focal_px * rectified.baseline_m)
    texts = []
    for side, camera, rotation, shift in zip(_SIDES, cameras, rotations, shifts, strict=True):
        P = np.hstack([rectified.matrix, [[shift], [0.0], [0.0]]])
        P[0, 2] = rectified.cx_right_px if side == "right" else rectified.cx_px
        name, coefficients = _name_lens(ROS_MODELS, camera, "ROS CameraInfo")
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
        texts.append(yaml.safe_dump(content, sort_keys=False, default_flow_style=None))
    for target, text in zip(paths, texts, strict=True):
        write_text(target, text)
    return paths


def _matrix(values: NDArray[Any]) -> dict[str, Any]:
    rows, columns = values.shape
    return {"rows": rows, "cols": columns, "data": values.ravel().tolist()}


def write_kalibr(path: StrPath, calibration: StereoCalibration) -> None:
    """Write a camera chain atomically."""
    chain: dict[str, Any] = {}
    for number, camera in enumerate((calibration.left, calibration.right)):
        name, coefficients = _name_lens(_KALIBR_MODELS, camera, "kalibr")
        K = camera.matrix
        chain[f"cam{number}"] = {
            "cam_overlaps": [1 - number],
            "camera_model": "pinhole",
            "distortion_coeffs": coefficients.tolist(),
            "distortion_model": name,
            "intrinsics": [float(K[0, 0]), float(K[1, 1]), float(K[0, 2]), float(K[1, 2])],
            "resolution": [camera.width_px, camera.height_px],
            "rostopic": f"/cam{number}/image_raw",
        }
    chain["cam1"]["T_cn_cnm1"] = calibration.T_right_left.tolist()
    write_text(path, yaml.safe_dump(chain, default_flow_style=None))


@reader
def read_euroc_truth(path: StrPath) -> Trajectory:
    """Read the true ``T_world_body``: ``time [ns], x y z, qw qx qy qz``, and more columns."""
    # Position and quaternion, with or without velocity and biases.
    table, _ = read_table(path, (17, 8))
    poses = [make_transform(rotation_from_quaternion(row[[5, 6, 7, 4]]), row[1:4]) for row in table]
    return Trajectory(np.stack(poses), table[:, 0] * NS)


def in_options(focal_px: float, baseline_m: float, cx_px: float, cy_px: float) -> str:
    """Return the options that give the camera of rectified images without a file."""
    return f"--focal {focal_px:g} --baseline {baseline_m:g} --cx {cx_px:g} --cy {cy_px:g}"


def pinhole_matrix(fx: float, fy: float, cx: float, cy: float) -> Float64:
    """Return float64 (3, 3) camera matrix, pixels."""
    return np.array([[fx, 0.0, cx], [0.0, fy, cy], [0.0, 0.0, 1.0]])


def _name_lens(models: Models, camera: CameraIntrinsics, form: str) -> tuple[str, Float64]:
    """Return a format's name for the lens of a camera, and the coefficients padded as it needs."""
    most = int(np.flatnonzero(camera.distortion).max(initial=-1)) + 1
    for name, (model, counts) in models.items():
        count = next((count for count in counts if count >= most), None)
        if model == camera.model and count is not None:
            padded = np.zeros(count)
            padded[:most] = camera.distortion[:most]
            return name, padded
    what = f"a {form} file cannot store this lens model"
    got = f"{camera.model} with {counted(most, 'coefficient')}"
    hint = "calibrate with --set calibration.radial_terms=2, or write another format"
    raise CalibrationError(what, got=got, expected=", ".join(models), hint=hint)
