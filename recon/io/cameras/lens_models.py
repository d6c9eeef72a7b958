"""Names of the lens models in ROS and kalibr, and their numbers of coefficients."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Final

import numpy as np

from recon.core.errors import CalibrationError, FormatError
from recon.core.values import CameraIntrinsics, LensModel
from recon.core.values.arrays import Float64
from recon.core.words import counted
from recon.io.files import StrPath

# Name -> our model and the permitted numbers of coefficients; a writer uses the first that fits.
Models = Mapping[str, tuple[LensModel, tuple[int, ...]]]

ROS_MODELS: Final[Models] = {
    "plumb_bob": ("pinhole", (5, 4, 0)),
    "rational_polynomial": ("pinhole", (8, 12, 14)),
    "equidistant": ("fisheye", (4,)),
    "fisheye": ("fisheye", (4,)),
}
KALIBR_MODELS: Final[Models] = {
    "radtan": ("pinhole", (4,)),
    "equidistant": ("fisheye", (4,)),
    "none": ("pinhole", (0,)),
}


def pinhole_matrix(fx: float, fy: float, cx: float, cy: float) -> Float64:
    """Return float64 (3, 3) camera matrix, pixels."""
    return np.array([[fx, 0.0, cx], [0.0, fy, cy], [0.0, 0.0, 1.0]])


def lens_of(
    models: Models, name: str, coefficients: Float64, path: StrPath
) -> tuple[LensModel, Float64]:
    """Return our lens model for a format's name, and its coefficients."""
    if name not in models:
        raise FormatError(
            "lens model is not supported", where=path, got=name, expected=", ".join(models)
        )
    model, counts = models[name]
    if coefficients.size not in counts:
        raise FormatError(
            f"lens model {name!r} has the wrong number of coefficients",
            where=path,
            got=coefficients.size,
            expected=" or ".join(str(count) for count in counts),
        )
    return model, coefficients


def name_lens(models: Models, camera: CameraIntrinsics, form: str) -> tuple[str, Float64]:
    """Return a format's name for the lens of a camera, and the coefficients padded as it needs.

    Args:
        models: The models of the format.
        camera: The camera.
        form: Name of the format, for the error message.
    """
    most = int(np.flatnonzero(camera.distortion).max(initial=-1)) + 1
    for name, (model, counts) in models.items():
        count = next((count for count in counts if count >= most), None)
        if model == camera.model and count is not None:
            padded = np.zeros(count)
            padded[:most] = camera.distortion[:most]
            return name, padded
    raise CalibrationError(
        f"a {form} file cannot store this lens model",
        got=f"{camera.model} with {counted(most, 'coefficient')}",
        expected=", ".join(models),
        hint="calibrate with --set calibration.radial_terms=2, or write another format",
    )
