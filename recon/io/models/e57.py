"""Point clouds as E57 files (extra ``survey``), the exchange format of laser scanning."""

from __future__ import annotations

from collections.abc import Iterable
from typing import Any, Final
from uuid import uuid4

import numpy as np

from recon.core.errors import require
from recon.core.geometry.se3 import apply
from recon.core.values import PointCloud
from recon.core.values.arrays import Float64
from recon.io.atomic import atomic_path
from recon.io.files import StrPath
from recon.io.models.columns import columns_of
from recon.io.models.las import check_crs

_AXES: Final = ("cartesianX", "cartesianY", "cartesianZ")


def write_e57(
    path: StrPath, clouds: Iterable[PointCloud], T_to_from: Float64, crs: str | None = None
) -> int:
    """Write clouds into one E57 file, atomically, each as a scan; returns the number of points.

    Positions are doubles from an offset of whole metres, which is the pose of each scan, so that
    programs that round to single precision keep millimetres; with colours where the clouds have
    them. ``T_to_from`` (4, 4) leads to the coordinates of the file, in the system ``crs``, whose
    WKT is in the header.

    Ref: ASTM E2807, "Standard specification for 3D imaging data exchange".
    """
    pye57 = require("pye57", extra="survey")
    wkt = "" if crs is None else check_crs(crs).to_wkt()
    offset_m, points = np.floor(T_to_from[:3, 3]), 0
    T_scan_from = T_to_from.copy()
    T_scan_from[:3, 3] -= offset_m
    with atomic_path(path) as temporary:
        try:
            with _opened(pye57, str(temporary), wkt) as file:
                for cloud in filter(len, clouds):
                    data = _columns(cloud, T_scan_from)
                    name = f"part {file.scan_count}"
                    file.write_scan_raw(data, name=name, translation=offset_m)
                    points += len(cloud)
        except pye57.libe57.E57Exception as error:
            raise OSError(str(error).partition("****")[0].strip()) from error
    return points


def _opened(pye57: Any, path: str, wkt: str) -> Any:
    """Open a file to be written; pye57 would leave its coordinate system empty for good."""

    class File(pye57.E57):  # type: ignore[misc]
        def write_default_header(self) -> None:
            node, file = pye57.libe57, self.image_file
            file.extensionsAdd("", node.E57_V1_0_URI)
            nodes = {
                "formatName": node.StringNode(file, "ASTM E57 3D Imaging Data File"),
                "guid": node.StringNode(file, f"{{{uuid4()}}}"),
                "versionMajor": node.IntegerNode(file, node.E57_FORMAT_MAJOR),
                "versionMinor": node.IntegerNode(file, node.E57_FORMAT_MINOR),
                "coordinateMetadata": node.StringNode(file, wkt),
                "data3D": node.VectorNode(file, True),
                "images2D": node.VectorNode(file, True),
            }
            for name, value in nodes.items():
                self.root.set(name, value)

        def __del__(self) -> None:
            """Do not close again what a full disk kept from being closed: Python would print it."""

    return File(path, mode="w")


def _columns(cloud: PointCloud, T_scan_from: Float64) -> dict[str, Any]:
    xyz = apply(T_scan_from, cloud.xyz.astype(np.float64))
    columns: dict[str, Any] = {
        name: np.ascontiguousarray(values) for name, values in zip(_AXES, xyz.T, strict=True)
    }
    columns["cartesianInvalidState"] = np.zeros(len(cloud), np.int8)  # readers look for it
    own = columns_of(cloud, "e57").items()
    return columns | {name: np.ascontiguousarray(values) for name, values in own}
