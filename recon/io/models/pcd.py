"""Point clouds as PCD files, the format of PCL."""

from __future__ import annotations

from collections.abc import Iterable
from typing import Any, Final

import numpy as np

from recon.core.values import PointCloud
from recon.core.values.arrays import UInt8
from recon.io.files import StrPath
from recon.io.models.ply_tables import Table, write_row_stream

_XYZ: Final = ("x", "y", "z")
_NORMAL: Final = ("normal_x", "normal_y", "normal_z")  # as PCL's own types name them
_EACH: Final = {"SIZE": "4", "TYPE": "F", "COUNT": "1"}  # of every field
_SCALARS: Final = (("confidence", "confidence"), ("sigma_m", "sigma"))


def write_pcd(path: StrPath, clouds: Iterable[PointCloud]) -> int:
    """Write clouds with the same fields into one binary PCD file, atomically; returns the points.

    Positions, normals, confidence and ``sigma`` (of the depth, metres) are float; a colour is the
    float whose bits are 0x00RRGGBB, as PCL wants it.

    Ref: https://pointclouds.org/documentation/tutorials/pcd_file_format.html, version 0.7.
    """
    nothing = _table(PointCloud(np.zeros((0, 3), np.float32)))
    return write_row_stream(path, map(_table, clouds), nothing, _header)


def _table(cloud: PointCloud) -> Table:
    columns = dict(zip(_XYZ, cloud.xyz.T, strict=True))
    if cloud.normals is not None:
        columns |= dict(zip(_NORMAL, cloud.normals.T, strict=True))
    if cloud.rgb is not None:
        columns["rgb"] = _packed(cloud.rgb)
    for attribute, name in _SCALARS:
        if (values := getattr(cloud, attribute)) is not None:
            columns[name] = values
    table = np.empty(len(cloud), [(name, "<f4") for name in columns])
    for name, values in columns.items():
        table[name] = values
    return table


def _packed(rgb: UInt8) -> Any:
    red, green, blue = rgb.T.astype("<u4")
    return (red << 16 | green << 8 | blue).view("<f4")


def _header(rows: int, filler: str, dtype: np.dtype[Any]) -> bytes:
    names = dtype.names or ()
    lines = [
        "# .PCD v0.7 - Point Cloud Data file format",
        f"# {filler}{filler}",  # the number of rows is named twice
        "VERSION 0.7",
        f"FIELDS {' '.join(names)}",
        *(f"{key} {' '.join([value] * len(names))}" for key, value in _EACH.items()),
        *(f"WIDTH {rows}", "HEIGHT 1", "VIEWPOINT 0 0 0 1 0 0 0", f"POINTS {rows}"),
        *("DATA binary", ""),
    ]
    return "\n".join(lines).encode()
