"""Kalibr's camera chain (camchain), for two cameras."""

from __future__ import annotations

from typing import Any

import yaml

from recon.core.errors import FormatError
from recon.core.geometry.se3 import orthonormalise
from recon.core.values import CameraIntrinsics, StereoCalibration
from recon.io.atomic import write_text
from recon.io.cameras.lens_models import KALIBR_MODELS, lens_of, name_lens, pinhole_matrix
from recon.io.fields import Fields
from recon.io.files import StrPath, reader
from recon.io.yaml_file import read_yaml


@reader
def read_kalibr(path: StrPath) -> StereoCalibration:
    """Read ``cam0`` as the left and ``cam1`` as the right camera of a camera chain.

    Ref: Kalibr's wiki, "Yaml formats": ``T_cn_cnm1`` maps points of camera n-1 to camera n.
    """
    fields = Fields(read_yaml(path), path)
    right = fields.below("cam1")
    T_right_left = orthonormalise(right.numbers("T_cn_cnm1", (4, 4)))
    return StereoCalibration(
        _camera(fields.below("cam0"), path), _camera(right, path), T_right_left
    )


def write_kalibr(path: StrPath, calibration: StereoCalibration) -> None:
    """Write a camera chain atomically."""
    chain: dict[str, Any] = {}
    for number, camera in enumerate((calibration.left, calibration.right)):
        name, coefficients = name_lens(KALIBR_MODELS, camera, "kalibr")
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


def _camera(fields: Fields, path: StrPath) -> CameraIntrinsics:
    if fields.text("camera_model") != "pinhole":
        raise FormatError(
            "camera model is not supported",
            where=path,
            got=fields.text("camera_model"),
            expected="pinhole (with radtan or equidistant distortion)",
        )
    model, distortion = lens_of(
        KALIBR_MODELS, fields.text("distortion_model"), fields.numbers("distortion_coeffs"), path
    )
    width, height = fields.numbers("resolution", (2,))
    matrix = pinhole_matrix(*fields.numbers("intrinsics", (4,)))
    return CameraIntrinsics(matrix, distortion, int(width), int(height), model)
