"""Calibration of Middlebury scenes: ``calib.txt`` of 2014, nominal values of 2005 and 2006."""

from __future__ import annotations

import re
from dataclasses import dataclass, replace
from typing import Final

import numpy as np

from recon.core.errors import CalibrationError
from recon.core.values import RectifiedCamera
from recon.core.values.arrays import Float64
from recon.io.fields import Fields
from recon.io.files import StrPath, read_text, reader

_LINE: Final = re.compile(r"^\s*(\w+)\s*=\s*(.*?)\s*$", re.MULTILINE)

# Ref: https://vision.middlebury.edu/stereo/data/scenes2005/ and scenes2006/, at full size.
_2005_FOCAL_PX: Final = 3740.0
_2005_BASELINE_M: Final = 0.160


@dataclass(frozen=True)
class MiddleburyCalib:
    """The content of a ``calib.txt``.

    Attributes:
        camera: The rectified camera, in metres.
        isint: True if the truth is in whole pixels, so that results are rounded as well.
        doffs_px: As in the file; that of the camera is the difference of its rounded principal
            points. None = not in the file.
    """

    camera: RectifiedCamera
    isint: bool = False
    doffs_px: float | None = None


@reader
def read_middlebury_calib(path: StrPath) -> MiddleburyCalib:
    """Read a ``calib.txt`` of the 2014 data or of MiddEval3."""
    fields = Fields(dict(_LINE.findall(read_text(path))), path)
    cam0, cam1 = (fields.numbers(key, (3, 3)) for key in ("cam0", "cam1"))
    doffs_px = fields.number("doffs")
    _check_views(cam0, cam1, doffs_px, path)
    size = (fields.count("width"), fields.count("height"))
    camera = RectifiedCamera.from_matrices(cam0, cam1, fields.number("baseline") / 1000, *size)
    if "ndisp" in fields:
        camera = replace(camera, ndisp=fields.count("ndisp"))
    isint = "isint" in fields and fields.number("isint") != 0
    return MiddleburyCalib(camera, isint, doffs_px)


def nominal_camera_2005(
    width_px: int, height_px: int, dmin_px: float, factor: float
) -> RectifiedCamera:
    """Return the nominal camera of a 2005 or 2006 scene, of that many full-size pixels per pixel.

    The images are cropped so that disparities are too small by ``dmin`` full-size pixels. The
    principal point is unknown and assumed at the image centre.
    """
    cx_px = (width_px - 1) / 2
    return RectifiedCamera(
        focal_px=_2005_FOCAL_PX / factor,
        cx_px=cx_px,
        cy_px=(height_px - 1) / 2,
        cx_right_px=cx_px + dmin_px / factor,
        baseline_m=_2005_BASELINE_M,
        width_px=width_px,
        height_px=height_px,
    )


def _check_views(cam0: Float64, cam1: Float64, doffs_px: float, path: StrPath) -> None:
    if not np.allclose(cam0[[0, 1, 1], [0, 1, 2]], cam1[[0, 1, 1], [0, 1, 2]], rtol=1e-4):
        raise CalibrationError("cam0 and cam1 have different focal lengths or rows", where=path)
    # Each value is printed with three decimals.
    if abs(cam1[0, 2] - cam0[0, 2] - doffs_px) > 0.01:
        raise CalibrationError(
            "doffs is not the difference of the principal points",
            where=path,
            got=f"{doffs_px:g}",
            expected=f"{cam1[0, 2] - cam0[0, 2]:g}",
        )
