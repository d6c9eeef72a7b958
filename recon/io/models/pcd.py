"""Point clouds as PCD files, the format of PCL."""

from __future__ import annotations

from collections.abc import Iterable
from typing import Any

import numpy as np

from recon.core.values import PointCloud
from recon.io.files import StrPath
from recon.io.models.columns import tables_of
from recon.io.models.ply_tables import write_row_stream


def write_pcd(path: StrPath, clouds: Iterable[PointCloud]) -> int:
    """Write clouds with the same fields into one binary PCD file, atomically; returns the points.

    Positions, normals, confidence and ``sigma`` (of the depth, metres) are float; a colour is the
    float whose bits are 0x00RRGGBB, as PCL wants it.

    Ref: https://pointclouds.org/documentation/tutorials/pcd_file_format.html, version 0.7.
    """
    return write_row_stream(path, tables_of(clouds, "pcd"), _header)


def _header(rows: int, filler: str, dtype: np.dtype[Any]) -> bytes:
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
