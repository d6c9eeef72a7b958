"""Lines with attributes as a GeoPackage, for programs of GIS (extra ``survey``)."""

from __future__ import annotations

import struct
from collections.abc import Mapping, Sequence
from typing import Any, Final

import numpy as np
from numpy.typing import NDArray

from recon.core.errors import require
from recon.core.values.arrays import Float64
from recon.io.atomic import atomic_path
from recon.io.files import StrPath
from recon.io.models.las import check_crs

_DATE: Final = "2000-01-01T00:00:00Z"  # of each change, so that equal lines are equal files
_LOCAL: Final = 'LOCAL_CS["map", UNIT["metre", 1.0], AXIS["x", EAST], AXIS["y", NORTH]]'


def write_lines(
    path: StrPath, lines: Sequence[Float64], columns: Mapping[str, NDArray[Any]], crs: str | None
) -> None:
    """Write lines (N, 2), east and north, with a value of each column, atomically.

    Ref: OGC 12-128r18, "OGC GeoPackage Encoding Standard", 2021; its lines are OGC's WKB.
    """
    pyogrio = require("pyogrio", extra="survey")
    pyogrio.set_gdal_config_options({"OGR_CURRENT_DATE": _DATE})
    shapes = [struct.pack("<BII", 1, 2, len(xy)) + xy.astype("<f8").tobytes() for xy in lines]
    system = _LOCAL if crs is None else check_crs(crs).to_wkt()
    with atomic_path(path) as temporary:
        try:
            pyogrio.raw.write(
                temporary, np.array(shapes, object), [*columns.values()], [*columns], crs=system,
                layer="contours", driver="GPKG", geometry_type="LineString", VERSION="1.2",
            )  # fmt: skip
        except pyogrio.errors.DataSourceError as error:
            raise OSError(str(error)) from error
