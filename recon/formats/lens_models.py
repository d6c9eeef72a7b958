"""What ROS and kalibr call the lens models, and how many coefficients each has there."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Final

import numpy as np

from recon.errors import CalibrationError, FormatError
from recon.formats.files import StrPath
from recon.structures import CameraIntrinsics, LensModel
from recon.structures.arrays import Float64

# Name -> our model, and the numbers of coefficients that the name allows; the first that will do is
# written.
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
    """float64 (3, 3) camera matrix, pixels."""
    return np.array([[fx, 0.0, cx], [0.0, fy, cy], [0.0, 0.0, 1.0]])


def lens_of(
    models: Models, name: str, coefficients: Float64, path: StrPath
) -> tuple[LensModel, Float64]:
    """Our model of a name, and its coefficients.

    Raises:
        FormatError: The model is not known, or has another number of coefficients.
    """
    if name not in models:
        raise FormatError(
            "lens model is not understood", where=path, got=name, expected=", ".join(models)
        )
    model, counts = models[name]
    if coefficients.size not in counts:
        raise FormatError(
            f"lens model {name!r} has another number of coefficients",
            where=path,
            got=coefficients.size,
            expected=" or ".join(str(count) for count in counts),
        )
    return model, coefficients


def name_lens(models: Models, camera: CameraIntrinsics, form: str) -> tuple[str, Float64]:
    """The name that a format has for a camera's lens, and the coefficients as it wants them.

    Args:
        models: What the format knows.
        camera: The camera.
        form: The format, named in the error.

    Raises:
        CalibrationError: The format has no name for it.
    """
    most = int(np.flatnonzero(camera.distortion).max(initial=-1)) + 1
    for name, (model, counts) in models.items():
        count = next((count for count in counts if count >= most), None)
        if model == camera.model and count is not None:
            padded = np.zeros(count)
            padded[:most] = camera.distortion[:most]
            return name, padded
    raise CalibrationError(
        f"a {form} file cannot hold this lens",
        got=f"{camera.model} with {most} coefficients",
        expected=", ".join(models),
        hint="calibrate with --set calibration.radial_terms=2, or write another format",
    )
