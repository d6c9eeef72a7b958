"""EuRoC (ASL) recordings: cameras as ``sensor.yaml``, ground truth as a table."""

from __future__ import annotations

from typing import Any, Final

import numpy as np

from recon.core.errors import FormatError
from recon.core.geometry.quaternion import rotation_from_quaternion
from recon.core.geometry.se3 import make_transform
from recon.core.values import CameraIntrinsics, Trajectory
from recon.core.values.arrays import Float64
from recon.io.cameras.lens_models import Models, lens_of, pinhole_matrix
from recon.io.files import StrPath, read_table, reader
from recon.io.yaml_file import read_yaml

_MODELS: Final[Models] = {
    "radial-tangential": ("pinhole", (4, 5)),
    "equidistant": ("fisheye", (4,)),
}
NS: Final = 1e-9


@reader
def read_euroc_camera(path: StrPath) -> tuple[CameraIntrinsics, Float64]:
    """Read one camera.

    Args:
        path: ``sensor.yaml`` in the folder of a camera.

    Returns:
        The camera, and float64 (4, 4) ``T_body_camera``, metres.

    Raises:
        FormatError: The file is missing or incomplete, or the lens model is not supported.
        CalibrationError: The values do not make a valid camera.
    """
    content = read_yaml(path)
    fu, fv, cu, cv = _numbers(content, "intrinsics", (4,), path)
    width_px, height_px = _numbers(content, "resolution", (2,), path).astype(int)
    model, distortion = lens_of(
        _MODELS,
        str(content.get("distortion_model", "radial-tangential")),
        _numbers(content, "distortion_coefficients", (None,), path),
        path,
    )
    camera = CameraIntrinsics(
        pinhole_matrix(fu, fv, cu, cv), distortion, int(width_px), int(height_px), model
    )
    pose = content.get("T_BS")
    data = pose.get("data") if isinstance(pose, dict) else None
    T = _numbers({"T_BS": data}, "T_BS", (16,), path).reshape(4, 4)
    return camera, make_transform(T[:3, :3], T[:3, 3])


@reader
def read_euroc_truth(path: StrPath) -> Trajectory:
    """Read the true trajectory of the body: ``time [ns], x y z, qw qx qy qz``, and more columns.

    Returns:
        ``T_world_body``, in the frame of the motion capture.

    Raises:
        FormatError: The file is missing or damaged.
    """
    # Position and quaternion, with or without velocity and biases.
    table, _ = read_table(path, (17, 8))
    poses = [make_transform(rotation_from_quaternion(row[[5, 6, 7, 4]]), row[1:4]) for row in table]
    return Trajectory(np.stack(poses), table[:, 0] * NS)


def _numbers(
    content: dict[str, Any], key: str, shape: tuple[int | None, ...], path: StrPath
) -> Float64:
    try:
        numbers = np.array(content[key], dtype=np.float64)
    except KeyError as error:
        raise FormatError(f"camera has no {key!r}", where=path) from error
    except (TypeError, ValueError) as error:
        raise FormatError(f"{key!r} is not a list of numbers", where=path) from error
    if numbers.ndim != 1 or shape[0] not in {None, numbers.size} or not np.isfinite(numbers).all():
        raise FormatError(
            f"{key!r} is invalid", where=path, expected=f"{shape[0] or 'only'} finite numbers"
        )
    return numbers
