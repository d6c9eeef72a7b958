"""PLY files: point clouds for MeshLab, CloudCompare and Open3D; and tables of any element.

Ref: G. Turk, "The PLY polygon file format", 1994.
"""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, replace
from os import SEEK_END
from pathlib import Path
from typing import IO, Any, Final

import numpy as np

from recon.core.errors import FormatError
from recon.core.text import counted, parse_numbers
from recon.core.values import ATTRIBUTES, Frame, PointCloud
from recon.core.values.arrays import Float32
from recon.io.atomic import atomic_path
from recon.io.files import StrPath, reader
from recon.io.models.columns import (
    AXES,
    Table,
    attributes_in,
    columns_of,
    positions_in,
    table_of,
    tables_of,
    write_row_stream,
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

    Positions and normals are float, colours uchar; ``quality``, float32 (N,), replaces the
    confidence; the frame is a comment. A file that cannot be written is an `OutputError`.
    """
    rated = cloud if quality is None else replace(cloud, confidence=quality)
    table = table_of(cloud.xyz, columns_of(rated, "ply"))
    write_tables(path, {"vertex": table}, [_FRAME + cloud.frame], ascii=ascii)


def write_ply_tiles(path: StrPath, clouds: Iterable[PointCloud], *, frame: Frame) -> int:
    """Write clouds of that frame with the same fields, one at a time; returns their points."""

    def header(rows: int, filler: str, dtype: np.dtype[Any]) -> bytes:
        return _header([("vertex", rows, dtype)], [_FRAME + frame, filler])

    return write_row_stream(path, tables_of(clouds, "ply"), header)


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


_TYPES: Final[dict[str, str]] = {
    "char": "i1", "uchar": "u1", "short": "i2", "ushort": "u2", "int": "i4", "uint": "u4",
    "float": "f4", "double": "f8", "int8": "i1", "uint8": "u1", "int16": "i2", "uint16": "u2",
    "int32": "i4", "uint32": "u4", "float32": "f4", "float64": "f8",
}  # fmt: skip
_NAMES: Final = {code: name for name, code in list(_TYPES.items())[:8]}
_ORDERS: Final = {"binary_little_endian": "<", "binary_big_endian": ">", "ascii": "<"}
_BINARY: Final = "binary_little_endian"
LIST_LENGTH: Final = " length"  # behind the name of a list: that of the field with its length
_LONGEST_HEADER_LINES: Final = 1000


@dataclass(frozen=True)
class PlyHeader:
    """The header of a PLY file."""

    encoding: str  # a key of _ORDERS
    elements: tuple[tuple[str, int, np.dtype[Any]], ...]  # name, number of rows, type of a row
    comments: tuple[str, ...]  # without the keyword


@reader
def read_tables(path: StrPath, wanted: Sequence[str]) -> tuple[PlyHeader, dict[str, Table]]:
    """Read the header and the wanted elements that the file has; what follows them is not read."""
    with Path(path).open("rb") as stream:
        header = _read_header(stream)
        tables: dict[str, Table] = {}
        missing = {name for name, _, _ in header.elements} & set(wanted)
        for name, count, dtype in header.elements:
            if not missing:
                break
            read = _read_text if header.encoding == "ascii" else _read_binary
            table = tables[name] = read(stream, count, dtype)
            for field_name, field in _fields(dtype):
                if field.shape and (table[field_name + LIST_LENGTH] != 3).any():
                    raise FormatError("a face is not a triangle", hint="triangulate the mesh first")
            if len(table) < count:
                what = f"the file is truncated in its element {name!r}"
                raise FormatError(what, got=counted(len(table), "row"), expected=f"{count}")
            missing.discard(name)
        return header, {name: table for name, table in tables.items() if name in wanted}


def write_tables(
    path: StrPath,
    tables: Mapping[str, Table],
    comments: Sequence[str] = (),
    *,
    ascii: bool = False,  # noqa: A002 - what the format calls it
) -> None:
    """Write tables as a PLY file, binary little endian unless ``ascii``, atomically."""
    elements = [(name, len(table), table.dtype) for name, table in tables.items()]
    with atomic_path(path) as temporary, temporary.open("wb") as stream:
        stream.write(_header(elements, comments, "ascii" if ascii else _BINARY))
        for table in tables.values():
            if ascii:
                _write_rows(stream, table)
            else:
                stream.write(table.tobytes())


def write_table_parts(path: StrPath, elements: Mapping[str, tuple[int, Iterable[Table]]]) -> None:
    """Write elements, each of so many rows and tables of one dtype, one at a time, atomically."""
    begun = {name: iter(tables) for name, (_, tables) in elements.items()}
    first = {name: next(tables) for name, tables in begun.items()}
    head = _header([(name, rows, first[name].dtype) for name, (rows, _) in elements.items()])
    with atomic_path(path) as temporary, temporary.open("wb") as stream:
        stream.write(head)
        for name, rest in begun.items():
            stream.write(first.pop(name).tobytes())
            for table in rest:
                stream.write(table.tobytes())


def _header(
    elements: Sequence[tuple[str, int | str, np.dtype[Any]]],
    comments: Sequence[str] = (),
    encoding: str = _BINARY,
) -> bytes:
    lines = ["ply", f"format {encoding} 1.0", *(f"comment {comment}" for comment in comments)]
    for name, rows, dtype in elements:
        lines.append(f"element {name} {rows}")
        for each, field in _fields(dtype):
            code = _NAMES[field.base.str[1:]]
            if field.shape:
                lines.append(f"property list uchar {code} {each}")
            elif not each.endswith(LIST_LENGTH):
                lines.append(f"property {code} {each}")
    return "\n".join([*lines, "end_header", ""]).encode()


def _fields(dtype: np.dtype[Any]) -> list[tuple[str, np.dtype[Any]]]:
    return [(name, dtype[name]) for name in dtype.names or ()]


def _write_rows(stream: IO[bytes], table: Table) -> None:
    """Write rows of text; nine digits reproduce a float32 exactly."""
    columns, formats = [], []
    for name, field in _fields(table.dtype):
        column = table[name].reshape(len(table), int(np.prod(field.shape)))
        columns.append(column.astype(np.float64))
        formats += ["%.9g" if field.base.kind == "f" else "%d"] * column.shape[1]
    np.savetxt(stream, np.concatenate(columns, axis=1), fmt=formats)


def _read_header(stream: IO[bytes]) -> PlyHeader:
    if stream.readline(8).strip() != b"ply":
        raise FormatError("not a PLY file: it does not start with 'ply'")
    encoding, comments = "", []
    elements: list[tuple[str, int, list[tuple[Any, ...]]]] = []
    for _ in range(_LONGEST_HEADER_LINES):
        line = stream.readline(4096).decode("ascii", errors="replace").strip()
        match line.split():
            case ["end_header"]:
                break
            case ["format", encoding, *_] if encoding in _ORDERS:
                pass
            case ["comment" | "obj_info", *_]:
                comments.append(line.partition(" ")[2])
            case ["element", name, count] if count.isdigit():
                elements.append((name, int(count), []))
            case ["property", "list", kind, of, name] if elements and {kind, of} <= _TYPES.keys():
                order = _ORDERS.get(encoding, "<")
                length = (name + LIST_LENGTH, order + _TYPES[kind])
                elements[-1][2].extend([length, (name, order + _TYPES[of], (3,))])
            case ["property", kind, name] if elements and kind in _TYPES:
                elements[-1][2].append((name, _ORDERS.get(encoding, "<") + _TYPES[kind]))
            case _:
                raise FormatError("cannot read the PLY header", got=repr(line[:60]))
    else:
        raise FormatError("the PLY header does not end")
    if not encoding:
        raise FormatError("the PLY header has no format line")
    try:
        typed = tuple((name, count, np.dtype(fields)) for name, count, fields in elements)
    except ValueError as error:
        raise FormatError("the PLY header names a property twice") from error
    return PlyHeader(encoding, typed, tuple(comments))


def _read_binary(stream: IO[bytes], count: int, dtype: np.dtype[Any]) -> Table:
    """Read at most ``count`` rows, fewer if the file ends early."""
    here = stream.tell()
    left = stream.seek(0, SEEK_END) - here
    stream.seek(here)
    # A damaged header may announce more rows than fit in memory.
    content = stream.read(min(count * dtype.itemsize, left))
    return np.frombuffer(content, dtype, len(content) // max(dtype.itemsize, 1))


def _read_text(stream: IO[bytes], count: int, dtype: np.dtype[Any]) -> Table:
    """Read rows of text up to the first that is missing or malformed."""
    widths = [int(np.prod(field.shape)) for _, field in _fields(dtype)]
    rows: list[list[float]] = []
    while len(rows) < count and (line := stream.readline()):
        try:
            numbers = parse_numbers(line.split())
        except ValueError:
            break
        if len(numbers) != sum(widths):
            break
        rows.append(numbers)
    values = np.array(rows, dtype=np.float64).reshape(len(rows), sum(widths))
    table = np.zeros(len(rows), dtype)
    columns = np.split(values, np.cumsum(widths), axis=1)
    for (name, field), part in zip(_fields(dtype), columns, strict=False):
        table[name] = part.reshape(len(rows), *field.shape)
    return table
