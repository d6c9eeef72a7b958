"""Point clouds as PLY files for MeshLab, CloudCompare and Open3D."""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import replace
from typing import Any, Final

import numpy as np
from numpy.typing import NDArray

from recon.core.errors import FormatError
from recon.core.values import Frame, PointCloud
from recon.core.values.arrays import Float32, UInt8
from recon.io.files import StrPath, reader
from recon.io.models.ply_tables import Table, read_tables, write_table_stream, write_tables

_XYZ: Final = ("x", "y", "z")
_NORMAL: Final = ("nx", "ny", "nz")
_COLOUR: Final = ("red", "green", "blue")
#: Scalars of a point: field of `PointCloud`, PLY property, type. MeshLab shows `quality`.
_SCALARS: Final = (
    ("confidence", "quality", "<f4"),
    ("sigma_m", "sigma", "<f4"),
    ("weight", "weight", "<f4"),
    ("count", "count", "<i4"),
)
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
    unless it is given; sigma, weight and count are written under their names if the cloud has them.
    The frame is a comment. A file that cannot be written is an `OutputError`.
    """
    rated = cloud if quality is None else replace(cloud, confidence=quality)
    write_tables(path, {"vertex": _table(rated)}, [_FRAME + cloud.frame], ascii=ascii)


def write_ply_tiles(path: StrPath, clouds: Iterable[PointCloud], *, frame: Frame) -> int:
    """Write clouds of that frame with the same fields, one at a time; returns their points."""
    nothing = _table(PointCloud(np.zeros((0, 3), np.float32), frame=frame))
    return write_table_stream(path, "vertex", map(_table, clouds), [_FRAME + frame], nothing)


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
    xyz = positions_of(vertex)
    _check_precision(vertex)
    cloud = PointCloud(
        xyz=xyz,
        rgb=colours_of(vertex),
        normals=normals_of(vertex),
        sigma_m=_scalar(vertex, "sigma", np.float32),
        confidence=_confidence(vertex),
        weight=_scalar(vertex, "weight", np.float32),
        count=_scalar(vertex, "count", np.int32),
        frame=next((f for c in header.comments for f in _FRAMES if c == _FRAME + f), "camera"),
    )
    finite = np.asarray(np.isfinite(cloud.xyz).all(axis=1))
    if len(cloud) and not finite.any():
        raise FormatError("no point of the PLY file is finite")
    return cloud if finite.all() else cloud.select(finite)


def vertex_dtype(*, normals: bool, colours: bool) -> list[tuple[str, str]]:
    """Return fields of a vertex table: position, and optionally normal and colour."""
    fields = [(name, "<f4") for name in _XYZ + (_NORMAL if normals else ())]
    return fields + [(name, "u1") for name in (_COLOUR if colours else ())]


def fill_vertices(
    table: Table, xyz: NDArray[Any], normals: NDArray[Any] | None, rgb: UInt8 | None
) -> None:
    """Copy positions, normals and colours into the fields of `vertex_dtype`."""
    for names, values in ((_XYZ, xyz), (_NORMAL, normals), (_COLOUR, rgb)):
        if values is not None:
            for column, name in enumerate(names):
                table[name] = values[:, column]


def positions_of(vertex: Table) -> Float32:
    """Return float32 (N, 3), the positions of a vertex table, which must have them."""
    if not _has(vertex, _XYZ):
        raise FormatError("the PLY file has no vertices with x, y and z")
    return _stacked(vertex, _XYZ, np.float32)


def normals_of(vertex: Table) -> NDArray[np.float32] | None:
    """Return float32 (N, 3), the normals of a vertex table, or None."""
    return _stacked(vertex, _NORMAL, np.float32) if _has(vertex, _NORMAL) else None


def colours_of(vertex: Table) -> UInt8 | None:
    """Return uint8 (N, 3), the colours of a vertex table, or None; float colours are in [0, 1]."""
    if not _has(vertex, _COLOUR):
        return None
    if vertex.dtype["red"].kind == "f":
        share = np.nan_to_num(_stacked(vertex, _COLOUR, np.float32))
        return np.asarray(np.rint(np.clip(share, 0, 1) * 255), dtype=np.uint8)
    return np.asarray(_stacked(vertex, _COLOUR, np.uint8))


def _table(cloud: PointCloud) -> Table:
    scalars = [row for row in _SCALARS if getattr(cloud, row[0]) is not None]
    fields = vertex_dtype(normals=cloud.normals is not None, colours=cloud.rgb is not None)
    table = np.zeros(len(cloud), fields + [(name, code) for _, name, code in scalars])
    fill_vertices(table, cloud.xyz, cloud.normals, cloud.rgb)
    for attribute, name, _ in scalars:
        table[name] = getattr(cloud, attribute)
    return table


def _check_precision(vertex: Table) -> None:
    """Reject coordinates that float32 would round too far, such as UTM: by up to half a metre."""
    for name in _XYZ:
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


def _has(table: Table, names: tuple[str, ...]) -> bool:
    return set(names) <= set(table.dtype.names or ())


def _stacked(table: Table, names: tuple[str, ...], dtype: type[Any]) -> NDArray[Any]:
    return np.stack([table[name] for name in names], axis=1).astype(dtype)


def _scalar(table: Table, name: str, dtype: type[Any]) -> NDArray[Any] | None:
    return table[name].astype(dtype) if _has(table, (name,)) else None


def _confidence(vertex: Table) -> NDArray[np.float32] | None:
    for name in ("quality", "confidence"):
        values = _scalar(vertex, name, np.float32)
        if values is not None and ((values >= 0) & (values <= 1)).all():
            return values
    return None
