"""Focal lengths in the EXIF data of photographs.

Ref: CIPA DC-008 (Exif 2.32), section 4.6.5; CIPA DCG-001 for the 35 mm equivalent.
"""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any, Final

from PIL import Image

from recon.core.errors import FormatError
from recon.io.files import StrPath, reading

_EXIF_IFD: Final = 0x8769
_FOCAL_LENGTH, _FOCAL_LENGTH_35MM = 0x920A, 0xA405
_SENSOR_RESOLUTION, _SENSOR_UNIT, _SENSOR_WIDTH_PX = 0xA20E, 0xA210, 0xA002
_MM_PER_UNIT: Final = {2: 25.4, 3: 10.0, 4: 1.0, 5: 0.001}
_DIAGONAL_35MM: Final = math.hypot(36.0, 24.0)


@dataclass(frozen=True)
class ExifFocal:
    """A focal length as a camera recorded it.

    Attributes:
        focal_px: In pixels of the image.
        basis: What it was computed from.
    """

    focal_px: float
    basis: str


def read_focal_length(path: StrPath, width_px: int, height_px: int) -> ExifFocal | None:
    """Read the focal length of a photograph: from its sensor data, or else the 35 mm equivalent.

    Args:
        path: The image.
        width_px: Its width, which may be less than the camera's if it was made smaller.
        height_px: Its height.

    Returns:
        The focal length; None = the file does not say, or is no image.
    """
    try:
        with reading(path), Image.open(path) as image:
            tags: Mapping[int, Any] = image.getexif().get_ifd(_EXIF_IFD)
            return _by_sensor(tags, width_px) or _by_35mm(tags, width_px, height_px)
    except FormatError:
        return None


def _by_sensor(tags: Mapping[int, Any], width_px: int) -> ExifFocal | None:
    focal_mm = _number(tags.get(_FOCAL_LENGTH))
    resolution = _number(tags.get(_SENSOR_RESOLUTION))
    unit_mm = _MM_PER_UNIT.get(tags.get(_SENSOR_UNIT, 2))
    recorded_px = _number(tags.get(_SENSOR_WIDTH_PX))
    if focal_mm is None or resolution is None or unit_mm is None or recorded_px is None:
        return None
    focal_px = focal_mm * resolution / unit_mm * width_px / recorded_px
    return ExifFocal(focal_px, f"{focal_mm:g} mm and the pixels of the sensor")


def _by_35mm(tags: Mapping[int, Any], width_px: int, height_px: int) -> ExifFocal | None:
    equivalent_mm = _number(tags.get(_FOCAL_LENGTH_35MM))
    if equivalent_mm is None:
        return None
    focal_px = equivalent_mm * math.hypot(width_px, height_px) / _DIAGONAL_35MM
    return ExifFocal(focal_px, f"{equivalent_mm:g} mm as 35 mm equivalent")


def _number(value: Any) -> float | None:
    """Return a positive finite number, or None; EXIF writes 0 or a fraction over 0 for unknown."""
    try:
        number = float(value)
    except (TypeError, ValueError, ZeroDivisionError):
        return None
    return number if math.isfinite(number) and number > 0 else None
