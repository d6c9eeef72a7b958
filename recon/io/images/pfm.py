"""PFM: disparity as 32-bit floats; unknown is inf in the file and NaN in memory."""

from __future__ import annotations

import re
from typing import Final

import numpy as np

from recon.core.errors import FormatError
from recon.core.values.arrays import Float32, frozen_array
from recon.core.words import counted
from recon.io.atomic import write_bytes
from recon.io.files import StrPath, read_bytes, reader

_HEADER: Final = re.compile(rb"(Pf|PF)\s+(\d+)\s+(\d+)\s+([-+.\deE]+)\s")


@reader
def read_pfm(path: StrPath) -> Float32:
    """Read a grey PFM file.

    The sign of the scale gives the byte order. Its magnitude is ignored, as in Middlebury's own
    reader: their files have 1/255 there, but the values are pixels.

    Returns:
        float32 (H, W), first row at the top; NaN where the file has ±inf or NaN.

    Raises:
        FormatError: The file is missing, truncated, not a PFM, or a colour PFM.
    """
    content = read_bytes(path)
    header = _HEADER.match(content)
    if header is None:
        raise FormatError("not a PFM file", where=path, expected="header 'Pf', width height, scale")
    kind, width, height, scale = header.groups()
    if kind == b"PF":
        raise FormatError("PFM file is in colour", where=path, expected="grey (header 'Pf')")
    order = "<f4" if _parse_scale(scale, path) < 0 else ">f4"
    shape = (int(height), int(width))
    return _unpack(content[header.end() :], order, shape, path)


def write_pfm(path: StrPath, values: Float32) -> None:
    """Write a grey little-endian PFM file atomically; NaN becomes inf.

    Args:
        path: File to write.
        values: float32 (H, W).

    Raises:
        ShapeError: The array has another dtype or shape.
        OutputError: The file cannot be written.
    """
    frozen_array("values", values, np.float32, (None, None))
    height, width = values.shape
    rows = np.where(np.isnan(values), np.float32(np.inf), values)[::-1]
    write_bytes(path, f"Pf\n{width} {height}\n-1.0\n".encode() + rows.astype("<f4").tobytes())


def _parse_scale(word: bytes, path: StrPath) -> float:
    try:
        scale = float(word)
    except ValueError:
        scale = 0.0
    if scale == 0 or not np.isfinite(scale):
        raise FormatError("scale of the PFM file is invalid", where=path, got=word.decode())
    return scale


def _unpack(body: bytes, order: str, shape: tuple[int, int], path: StrPath) -> Float32:
    pixels = shape[0] * shape[1]
    if pixels == 0 or len(body) < 4 * pixels:
        raise FormatError(
            "PFM file is truncated",
            where=path,
            got=counted(len(body), "byte"),
            expected=f"{4 * pixels} for {shape[1]}x{shape[0]} pixels",
        )
    values = np.frombuffer(body, dtype=order, count=pixels).reshape(shape)[::-1]
    return np.where(np.isfinite(values), values, np.nan).astype(np.float32)
