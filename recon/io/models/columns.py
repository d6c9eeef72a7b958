"""The points of clouds and meshes as columns, under the names that a format has for them."""

from __future__ import annotations

from collections.abc import Iterable, Iterator
from itertools import chain
from typing import Any, Final

import numpy as np
from numpy.typing import NDArray

from recon.core.errors import FormatError
from recon.core.values import ATTRIBUTES, Attribute, PointCloud, TriangleMesh
from recon.core.values.arrays import Float32
from recon.core.values.cloud import Format
from recon.io.models.ply_tables import Table

Columns = dict[str, NDArray[Any]]
AXES: Final = ("x", "y", "z")


def columns_of(points: PointCloud | TriangleMesh, of: Format) -> Columns:
    """Return the attributes of points that a format has names for, each column (N,) under its."""
    found: Columns = {}
    for each in ATTRIBUTES:
        values, names = getattr(points, each.name, None), getattr(each, of)
        if values is not None and names:
            found |= zip(names, _split(values, len(names)), strict=True)
    return found


def _split(values: NDArray[Any], columns: int) -> NDArray[Any]:
    """Return values (N, …) as so many columns; three bytes in one are bits of a float."""
    if values.ndim > columns:
        red, green, blue = values.T.astype("<u4")
        values = (red << 16 | green << 8 | blue).view("<f4")
    return np.asarray(values.reshape(len(values), columns).T)


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
                found[each.name] = _as_own(each, values)
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


def _as_own(each: Attribute, values: NDArray[Any]) -> NDArray[Any]:
    """Return values (N, width) in the dtype of an attribute; colours that are floats are shares."""
    if each.width > 1 and each.dtype is np.uint8 and values.dtype.kind == "f":
        values = np.rint(np.clip(np.nan_to_num(values.astype(np.float32)), 0, 1) * 255)
    return values.astype(each.dtype).reshape(each.shape(len(values)))


def with_first(clouds: Iterable[PointCloud]) -> tuple[PointCloud, Iterator[PointCloud]]:
    """Return the first cloud with points, whose attributes all have, and those with points."""
    parts = filter(len, clouds)
    first = next(parts, PointCloud(np.zeros((0, 3), np.float32)))
    return first, chain([first], parts)
