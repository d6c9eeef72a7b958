"""The points of clouds and meshes as columns, under the names that a format has for them.

Two formats are nothing but columns: PCD, that of PCL, and archives of NumPy (``.npz``).
"""

from __future__ import annotations

import shutil
import tempfile
from collections.abc import Callable, Iterable, Iterator, Mapping
from contextlib import ExitStack
from itertools import chain
from typing import IO, Any, Final
from zipfile import ZIP_DEFLATED, ZipFile

import numpy as np
from numpy.typing import NDArray

from recon.core.errors import FormatError
from recon.core.values import ATTRIBUTES, Attribute, PointCloud, TriangleMesh
from recon.core.values.arrays import Float32
from recon.core.values.cloud import Format
from recon.io.atomic import atomic_path
from recon.io.files import StrPath

Table = NDArray[Any]  # structured, with a field for each column
Columns = dict[str, NDArray[Any]]
AXES: Final = ("x", "y", "z")
_LONGEST_NUMBER: Final = 20


def columns_of(points: PointCloud | TriangleMesh, of: Format) -> Columns:
    """Return the attributes of points that a format has names for, each column (N,) under its."""
    found: Columns = {}
    for each in ATTRIBUTES:
        values, names = getattr(points, each.name, None), getattr(each, of)
        if values is not None and names:
            if values.ndim > len(names):  # three bytes in one column are bits of a float
                red, green, blue = values.T.astype("<u4")
                values = (red << 16 | green << 8 | blue).view("<f4")
            found |= zip(names, values.reshape(len(values), len(names)).T, strict=True)
    return found


def table_of(xyz: NDArray[Any], columns: Columns) -> Table:
    """Return a table of points: x, y, z and other columns."""
    columns = dict(zip(AXES, xyz.T, strict=True)) | columns
    table = np.empty(len(xyz), [(name, values.dtype) for name, values in columns.items()])
    for name, values in columns.items():
        table[name] = values
    return table


def tables_of(clouds: Iterable[PointCloud], of: Format) -> Iterator[Table]:
    """Yield the tables of clouds with points, or one without rows."""
    return (table_of(cloud.xyz, columns_of(cloud, of)) for cloud in with_first(clouds)[1])


def positions_in(table: Table) -> Float32:
    """Return float32 (N, 3), the positions of a table, which must have them."""
    if (xyz := _stacked(table, AXES)) is None:
        raise FormatError("the PLY file has no vertices with x, y and z")
    return xyz.astype(np.float32)


def attributes_in(table: Table, *names: str) -> dict[str, Any]:
    """Return the attributes of these names that a table of PLY has, perhaps under their own."""
    found = {}
    for each in ATTRIBUTES:
        for columns in (each.ply, (each.name,)):
            values = _stacked(table, columns) if each.name in names else None
            if values is not None and each.name not in found and _within(each, values):
                if each.width > 1 and each.dtype is np.uint8 and values.dtype.kind == "f":
                    # Colours as floats are fractions.
                    values = np.clip(np.nan_to_num(values.astype(np.float32)), 0, 1)
                    values = np.rint(values * 255)
                found[each.name] = values.astype(each.dtype).reshape(each.shape(len(values)))
    return found


def _stacked(table: Table, names: tuple[str, ...]) -> NDArray[Any] | None:
    if not names or not set(names) <= set(table.dtype.names or ()):
        return None
    return np.stack([table[name] for name in names], axis=1)


def _within(each: Attribute, values: NDArray[Any]) -> bool:
    if values.shape[1] != each.width or each.bounds is None:
        return len(values.T) == each.width
    low, high = each.bounds
    return bool(np.all((values >= low) & (values <= high)))


def with_first(clouds: Iterable[PointCloud]) -> tuple[PointCloud, Iterator[PointCloud]]:
    """Return the first cloud with points, whose attributes all have, and those with points."""
    parts = filter(len, clouds)
    first = next(parts, PointCloud(np.zeros((0, 3), np.float32)))
    return first, chain([first], parts)


def write_row_stream(
    path: StrPath, tables: Iterator[Table], header: Callable[[int, str, np.dtype[Any]], bytes]
) -> int:
    """Write rows that arrive in parts, behind a header that says how many, atomically.

    All tables get the dtype of the first. The number of rows is filled in at the end: ``header``
    has a comment with a filler of dots, so that it is as long for every number.
    """
    first, rows = next(tables), 0

    def head() -> bytes:
        return header(rows, "." * (_LONGEST_NUMBER - len(str(rows))), first.dtype)

    with atomic_path(path) as temporary, temporary.open("wb") as stream:
        stream.write(head())
        for table in chain([first], tables):
            stream.write(table.astype(first.dtype, copy=False).tobytes())
            rows += len(table)
        stream.seek(0)
        stream.write(head())
    return rows


def write_pcd(path: StrPath, clouds: Iterable[PointCloud]) -> int:
    """Write clouds with the same fields into one binary PCD file, atomically; returns the points.

    Values are float; a colour is the float whose bits are 0x00RRGGBB, as PCL wants it.

    Ref: https://pointclouds.org/documentation/tutorials/pcd_file_format.html, version 0.7.
    """

    def header(rows: int, filler: str, dtype: np.dtype[Any]) -> bytes:
        names = dtype.names or ()
        each = [dtype[name] for name in names]
        lines = [
            "# .PCD v0.7 - Point Cloud Data file format",
            f"# {filler}{filler}",  # the number of rows is named twice
            "VERSION 0.7",
            f"FIELDS {' '.join(names)}",
            f"SIZE {' '.join(str(one.itemsize) for one in each)}",
            f"TYPE {' '.join(one.kind.upper() for one in each)}",
            f"COUNT {' '.join('1' for _ in each)}",
            *(f"WIDTH {rows}", "HEIGHT 1", "VIEWPOINT 0 0 0 1 0 0 0", f"POINTS {rows}"),
            *("DATA binary", ""),
        ]
        return "\n".join(lines).encode()

    return write_row_stream(path, tables_of(clouds, "pcd"), header)


Arrays = Mapping[str, NDArray[Any]]
_LEVEL: Final = 1  # of compression: coordinates hardly get smaller with more


def write_npz(path: StrPath, parts: Iterable[Arrays], whole: Arrays) -> int:
    """Write arrays into one archive, atomically; returns the rows of the parts.

    Arrays of the same name in all ``parts`` (n, ...) become one, in a file beside until all have
    arrived, so that memory holds one part; their names are those of the first.
    """
    rows, shapes = 0, {name: (array.dtype, array.shape) for name, array in whole.items()}
    with ExitStack() as stack:
        temporary = stack.enter_context(atomic_path(path))
        files: dict[str, IO[bytes]] = {}
        for part in parts:
            if not files:
                files = {
                    name: stack.enter_context(tempfile.TemporaryFile(dir=temporary.parent))
                    for name in part
                }
            for name, file in files.items():
                file.write(part[name].tobytes())
                shapes[name] = (part[name].dtype, part[name].shape[1:])
            rows += len(next(iter(part.values())))
        archive = stack.enter_context(
            ZipFile(temporary, "w", ZIP_DEFLATED, compresslevel=_LEVEL, allowZip64=True)
        )
        for name, (dtype, shape) in shapes.items():
            with archive.open(f"{name}.npy", "w", force_zip64=True) as entry:
                if name not in files:
                    np.lib.format.write_array(entry, whole[name], allow_pickle=False)
                    continue
                header = {"descr": dtype.str, "fortran_order": False, "shape": (rows, *shape)}
                np.lib.format.write_array_header_1_0(entry, header)
                files[name].seek(0)
                shutil.copyfileobj(files[name], entry)
        archive.close()
    return rows
