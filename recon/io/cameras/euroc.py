"""EuRoC (ASL) recordings: cameras as ``sensor.yaml``, ground truth as a table."""

from __future__ import annotations

from typing import Final

import numpy as np

from recon.core.geometry.se3 import make_transform, rotation_from_quaternion
from recon.core.values import CameraIntrinsics, Trajectory
from recon.core.values.arrays import Float64
from recon.io.cameras.lens_models import Models, lens_of, pinhole_matrix
from recon.io.fields import Fields
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
    """
    fields = Fields(read_yaml(path), path)
    width_px, height_px = fields.numbers("resolution", (2,)).astype(int)
    name = "distortion_model"
    model, distortion = lens_of(
        _MODELS,
        fields.text(name) if name in fields else "radial-tangential",
        fields.numbers("distortion_coefficients"),
        path,
    )
    matrix = pinhole_matrix(*fields.numbers("intrinsics", (4,)))
    camera = CameraIntrinsics(matrix, distortion, int(width_px), int(height_px), model)
    T = fields.below("T_BS").numbers("data", (4, 4))
    return camera, make_transform(T[:3, :3], T[:3, 3])


@reader
def read_euroc_truth(path: StrPath) -> Trajectory:
    """Read the true trajectory of the body: ``time [ns], x y z, qw qx qy qz``, and more columns.

    Returns:
        ``T_world_body``, in the frame of the motion capture.
    """
    # Position and quaternion, with or without velocity and biases.
    table, _ = read_table(path, (17, 8))
    poses = [make_transform(rotation_from_quaternion(row[[5, 6, 7, 4]]), row[1:4]) for row in table]
    return Trajectory(np.stack(poses), table[:, 0] * NS)
