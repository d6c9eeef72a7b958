"""Disparity as a 16-bit PNG: ``256·d``, 0 = unknown (KITTI); disparity files of either kind."""

from __future__ import annotations

import math
from pathlib import Path

import numpy as np

from recon.core.errors import FormatError, OutputError
from recon.core.values.arrays import Float32, frozen_array
from recon.io.files import StrPath, reader
from recon.io.images.image import read_grey_levels, write_image
from recon.io.images.pfm import read_pfm


def read_disparity(path: StrPath) -> Float32:
    """Return a disparity map, PFM or 16-bit PNG by its suffix: float32 (H, W), NaN = unknown."""
    return read_pfm(path) if Path(path).suffix.lower() == ".pfm" else read_disparity_png(path)


@reader
def read_disparity_png(path: StrPath, *, scale: float = 256.0) -> Float32:
    """Read a disparity stored as grey levels.

    Args:
        path: PNG or PGM of 8 or 16 bits.
        scale: Grey levels per pixel of disparity: 256 in KITTI; 4, 8 or 16 in Middlebury.

    Returns:
        float32 (H, W), pixels; NaN where the level is 0.
    """
    levels = read_grey_levels(path)
    if levels.dtype == np.uint8 and scale > 255:
        raise FormatError("disparity image has 8 bits", where=path, expected="16 bits")
    values: Float32 = levels.astype(np.float32) / np.float32(scale)
    values[levels == 0] = np.nan
    return values


def write_disparity_png(path: StrPath, values: Float32, *, scale: float = 256.0) -> None:
    """Write a disparity as a 16-bit PNG atomically.

    A disparity that would round to 0 becomes level 1, as in KITTI's own writer, because level 0
    means unknown.

    Args:
        path: Ends in .png.
        values: float32 (H, W), pixels; NaN = unknown.
        scale: Grey levels per pixel; see `fitting_scale`.
    """
    frozen_array("values", values, np.float32, (None, None))
    known = np.isfinite(values)
    levels = np.rint(np.where(known, values, 0).astype(np.float64) * scale)
    if (levels < 0).any() or (levels > 65535).any():
        raise OutputError(
            "disparity does not fit a 16-bit image",
            where=path,
            got=f"{values[known].min():g} to {values[known].max():g} px",
            expected=f"0 to {65535 / scale:g} px",
            hint="write PFM instead, or use a smaller scale",
        )
    write_image(path, np.where(known, np.maximum(levels, 1), 0).astype(np.uint16))


def fitting_scale(values: Float32) -> float:
    """Return the largest power of two, at most KITTI's 256, for which ``values`` fit 16 bits."""
    highest = max(1.0, float(np.nanmax(values, initial=1.0)))
    return min(256.0, 2.0 ** math.floor(math.log2(65535 / highest)))
