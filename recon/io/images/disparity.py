"""Disparity maps: PFM (32-bit floats, unknown = inf), PNG (KITTI's ``256·d``, unknown = 0)."""

from __future__ import annotations

import math
import re
from pathlib import Path
from typing import Final

import numpy as np

from recon.core.errors import FormatError, OutputError
from recon.core.text import counted
from recon.core.values.arrays import Float32, frozen_array
from recon.io.atomic import write_bytes
from recon.io.files import StrPath, read_bytes, reader
from recon.io.images.image import read_grey_levels, write_image

_HEADER: Final = re.compile(rb"(Pf|PF)\s+(\d+)\s+(\d+)\s+([-+.\deE]+)\s")


def read_disparity(path: StrPath) -> Float32:
    """Return a disparity map, PFM or 16-bit PNG by its suffix: float32 (H, W), NaN = unknown."""
    return read_pfm(path) if Path(path).suffix.lower() == ".pfm" else read_disparity_png(path)


@reader
def read_pfm(path: StrPath) -> Float32:
    """Read a grey PFM file: float32 (H, W), first row at the top; NaN where it has ±inf or NaN.

    The sign of the scale gives the byte order. Its magnitude is ignored, as by Middlebury, whose
    files have 1/255 there for values in pixels. A damaged file or one in colour is a `FormatError`.
    """
    content = read_bytes(path)
    header = _HEADER.match(content)
    if header is None:
        raise FormatError("not a PFM file", expected="header 'Pf', width height, scale")
    kind, *size, word = header.groups()
    if kind == b"PF":
        raise FormatError("PFM file is in colour", expected="grey (header 'Pf')")
    try:
        scale = float(word)
    except ValueError:
        scale = 0.0
    if scale == 0 or not np.isfinite(scale):
        raise FormatError("scale of the PFM file is invalid", got=word.decode())
    width, height = map(int, size)
    body, pixels = content[header.end() :], width * height
    if pixels == 0 or len(body) < 4 * pixels:
        expected = f"{4 * pixels} for {width}x{height} pixels"
        got = counted(len(body), "byte")
        raise FormatError("PFM file is truncated", got=got, expected=expected)
    stored = np.frombuffer(body, "<f4" if scale < 0 else ">f4", pixels)
    values = stored.reshape(height, width)[::-1]
    return np.where(np.isfinite(values), values, np.nan).astype(np.float32)


def write_pfm(path: StrPath, values: Float32) -> None:
    """Write float32 (H, W) as a grey little-endian PFM file, atomically; NaN becomes inf."""
    frozen_array("values", values, np.float32, (None, None))
    height, width = values.shape
    rows = np.where(np.isnan(values), np.float32(np.inf), values)[::-1]
    write_bytes(path, f"Pf\n{width} {height}\n-1.0\n".encode() + rows.astype("<f4").tobytes())


@reader
def read_disparity_png(path: StrPath, *, scale: float = 256.0) -> Float32:
    """Read grey levels, so many per pixel (256 in KITTI): float32 (H, W), NaN where it is 0."""
    levels = read_grey_levels(path)
    if levels.dtype == np.uint8 and scale > 255:
        raise FormatError("disparity image has 8 bits", expected="16 bits")
    values: Float32 = levels.astype(np.float32) / np.float32(scale)
    values[levels == 0] = np.nan
    return values


def write_disparity_png(path: StrPath, values: Float32, *, scale: float = 256.0) -> None:
    """Write ``scale · disparity``, at least 1, as 16-bit grey levels, atomically; 0 = NaN."""
    frozen_array("values", values, np.float32, (None, None))
    known = np.isfinite(values)
    levels = np.rint(np.where(known, values, 0).astype(np.float64) * scale)
    if (levels < 0).any() or (levels > 65535).any():
        what = "disparity does not fit a 16-bit image"
        got = f"{values[known].min():g} to {values[known].max():g} px"
        expected, hint = f"0 to {65535 / scale:g} px", "write PFM instead, or use a smaller scale"
        raise OutputError(what, where=path, got=got, expected=expected, hint=hint)
    write_image(path, np.where(known, np.maximum(levels, 1), 0).astype(np.uint16))


def fitting_scale(values: Float32) -> float:
    """Return the largest power of two, at most KITTI's 256, for which ``values`` fit 16 bits."""
    highest = max(1.0, float(np.nanmax(values, initial=1.0)))
    return min(256.0, 2.0 ** math.floor(math.log2(65535 / highest)))
