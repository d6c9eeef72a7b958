"""Point clouds as PLY files for MeshLab, CloudCompare and Open3D."""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import replace
from typing import Final

import numpy as np

from recon.core.errors import FormatError
from recon.core.values import ATTRIBUTES, Frame, PointCloud
from recon.core.values.arrays import Float32
from recon.io.files import StrPath, reader
from recon.io.models.columns import (
    AXES,
    attributes_in,
    columns_of,
    positions_in,
    table_of,
    tables_of,
)
from recon.io.models.ply_tables import Table, read_tables, write_table_stream, write_tables

_FRAME: Final = "frame "
# Less than any stereo camera or laser scanner measures.
_LARGEST_ROUNDING_M: Final = 0.005
_FRAMES: Final[tuple[Frame, ...]] = ("camera", "world", "map")


def write_ply(
    path: StrPath,
    cloud: PointCloud,
    *,
    quality: Float32 | None = None,
    ascii: bool = False,  # noqa: A002 - what the format calls it
) -> None:
    """Write a cloud atomically, binary little endian, or text with the same values if ``ascii``.

    Positions and normals are float, colours uchar; ``quality``, float32 (N,), is the confidence
    unless it is given; what else the cloud has is written as `ATTRIBUTES` say.
    The frame is a comment. A file that cannot be written is an `OutputError`.
    """
    rated = cloud if quality is None else replace(cloud, confidence=quality)
    table = table_of(cloud.xyz, columns_of(rated, "ply"))
    write_tables(path, {"vertex": table}, [_FRAME + cloud.frame], ascii=ascii)


def write_ply_tiles(path: StrPath, clouds: Iterable[PointCloud], *, frame: Frame) -> int:
    """Write clouds of that frame with the same fields, one at a time; returns their points."""
    return write_table_stream(path, "vertex", tables_of(clouds, "ply"), [_FRAME + frame])


@reader
def read_ply(path: StrPath) -> PointCloud:
    """Read the vertices of a cloud or mesh, in ascii or binary, float or double; it may be empty.

    Points with a non-finite coordinate are dropped; organised clouds mark their gaps that way.
    ``quality`` (or ``confidence``) becomes the confidence if all values lie in [0, 1]. The frame is
    that named in the file, else ``camera``.

    Raises:
        FormatError: The file is missing, truncated, not a PLY, has no x, y, z, has points none of
            which is finite, or doubles that float32 would move by millimetres.
    """
    header, tables = read_tables(path, ["vertex"])
    vertex = tables.get("vertex", np.zeros(0))
    xyz = positions_in(vertex)
    _check_precision(vertex)
    known = attributes_in(vertex, *(each.name for each in ATTRIBUTES))
    frames = [f for c in header.comments for f in _FRAMES if c == _FRAME + f]
    cloud = PointCloud(xyz, frame=frames[0] if frames else "camera", **known)
    finite = np.asarray(np.isfinite(cloud.xyz).all(axis=1))
    if len(cloud) and not finite.any():
        raise FormatError("no point of the PLY file is finite")
    return cloud if finite.all() else cloud.select(finite)


def _check_precision(vertex: Table) -> None:
    """Reject coordinates that float32 would round too far, such as UTM: by up to half a metre."""
    for name in AXES:
        exact = vertex[name]
        if exact.dtype.itemsize <= 4:
            continue
        exact = exact[np.isfinite(exact)]
        with np.errstate(over="ignore"):
            moved_m = np.abs(exact.astype(np.float32) - exact).max(initial=0.0)
        if moved_m > _LARGEST_ROUNDING_M:
            raise FormatError(
                "coordinates are too large to be kept in single precision",
                got=f"{name} up to {np.abs(exact).max():.10g}, rounded by {moved_m:.2g} m",
                expected=f"rounded by at most {_LARGEST_ROUNDING_M:g} m",
                hint="subtract an offset, such as the first point, from all coordinates",
            )
