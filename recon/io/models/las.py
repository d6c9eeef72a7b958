"""Point clouds as LAS and LAZ files (extra ``survey``), the formats of surveying programs."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any, Final

import numpy as np

from recon.core.errors import EvaluationError, SettingsError, require
from recon.core.geometry.se3 import apply
from recon.core.values import PointCloud
from recon.core.values.arrays import Bool, Float64
from recon.io.atomic import atomic_path
from recon.io.files import StrPath
from recon.io.models.columns import columns_of, with_first

_EXTRA: Final = "survey"
COLOURED: Final = 7  # point format with colours, of LAS 1.4
_STEP_M: Final = 0.001
_MARGIN_DEG: Final = 6.0  # systems are used as far outside their area as a zone of UTM is wide
_LARGEST_STRETCH: Final = 2.0  # of a metre on the ground: Mercator's at 60 degrees north
_FULL_COLOUR: Final = 257  # colours have 16 bits: 255 becomes 65535
AreGround = Callable[[PointCloud], Bool]  # which points of a cloud are ground, (N,)


def write_las(
    path: StrPath,
    clouds: Iterable[PointCloud],
    T_to_from: Float64,
    crs: str | None = None,
    step_m: float = _STEP_M,
    ground: AreGround | None = None,
) -> int:
    """Write clouds into one LAS 1.4 file, atomically; compressed if it ends in ``.laz``.

    Positions are rounded to multiples of ``step_m``; colours and, as extra dimensions, what else
    `ATTRIBUTES` say are written where the clouds have them, all the same. ``T_to_from``
    (4, 4) leads to the coordinates of the file, in the system ``crs``. Points that ``ground`` says
    are ground have class 2, all others 1, unclassified. The number of points is returned.

    Ref: ASPRS, "LAS specification 1.4 - R15", 2019.
    """
    laspy, points = require("laspy", extra=_EXTRA), 0
    first, clouds = with_first(clouds)
    header, packed = las_header(laspy, first, T_to_from, crs, step_m), Path(path).suffix == ".laz"
    with (
        packing(path) as temporary,
        laspy.open(temporary, mode="w", header=header, do_compress=packed) as file,
    ):
        for cloud in clouds:
            file.write_points(las_record(laspy, header, cloud, T_to_from, ground))
            points += len(cloud)
    return points


@contextmanager
def packing(path: StrPath) -> Iterator[Path]:
    """Give a path as `atomic_path` does; what compresses has an error of its own for full disks."""
    lazrs = require("lazrs", extra=_EXTRA)
    with atomic_path(path) as temporary:
        try:
            yield temporary
        except lazrs.LazrsError as error:
            raise OSError(str(error)) from error


def las_header(
    laspy: Any, first: PointCloud, T_to_from: Float64, crs: str | None, step_m: float
) -> Any:
    """Return the header of a file as `write_las` describes it, without points."""
    header = laspy.LasHeader(point_format=COLOURED, version="1.4")
    header.generating_software = "recon"
    header.global_encoding.wkt = True  # as the format of its points needs, even without a system
    header.scales, header.offsets = np.full(3, step_m), np.floor(T_to_from[:3, 3])
    for each, _ in first.attributes:
        if each.las and each.width == 1:
            header.add_extra_dim(laspy.ExtraBytesParams(*each.las, each.dtype, each.about))
    if crs is not None:
        header.add_crs(check_crs(crs))
    return header


def check_crs(crs: str, where: StrPath = "--crs") -> Any:
    """Return the coordinate system of a name such as ``EPSG:25832``; ``where`` it is given."""
    pyproj, expected = require("pyproj", extra=_EXTRA), "a projected system, such as EPSG:25832"
    try:
        found = pyproj.CRS.from_user_input(crs)
    except pyproj.exceptions.CRSError as error:
        what = "unknown coordinate system"
        raise SettingsError(what, where=where, got=crs, expected="such as EPSG:25832") from error
    got = f"{crs} ({found.name})"
    units = {axis.unit_name for axis in found.axis_info}
    if not found.is_projected or units != {"metre"}:
        what = "the coordinates of this system are not metres to the east and north"
        got = f"{crs} ({found.name}; {', '.join(sorted(units))})"
        raise SettingsError(what, where=where, got=got, expected=expected)
    try:
        pyproj.Transformer.from_crs(found, found.geodetic_crs)
    except pyproj.exceptions.ProjError as error:  # UTM without a zone: EPSG:32600
        what = "positions cannot be converted to this coordinate system"
        raise SettingsError(what, where=where, got=got, expected=expected) from error
    return found


def check_inside(crs: str, position_m: Float64, where: StrPath) -> None:
    """Check that a position (east, north, up) lies where its coordinate system is used."""
    system = check_crs(crs)
    area = system.area_of_use
    pyproj = require("pyproj", extra=_EXTRA)
    to_degrees = pyproj.Transformer.from_crs(system, system.geodetic_crs, always_xy=True)
    east_m, north_m = (position_m[:2] + np.array([[0.0, 0.0], [1.0, 0.0], [0.0, 1.0]])).T
    lons, lats = to_degrees.transform(east_m, north_m)
    lon, lat = lons[0], lats[0]
    if area is None:
        _check_metres(system, lons, lats, where)
        return
    wide = area.east - area.west + (360.0 if area.east < area.west else 0.0)
    east_of_west = (lon - area.west + _MARGIN_DEG) % 360.0
    if (
        east_of_west <= wide + 2 * _MARGIN_DEG
        and area.south - _MARGIN_DEG <= lat <= area.north + _MARGIN_DEG
    ):
        return
    what = "the positions lie outside the area of their coordinate system"
    got = f"easting {position_m[0]:.0f}, northing {position_m[1]:.0f} in {crs}"
    lon_lat = f"longitude {area.west:g} to {area.east:g}, latitude {area.south:g} to {area.north:g}"
    hint = "columns are time, easting, northing, height in metres; without --crs any are taken"
    raise EvaluationError(what, where=where, got=got, expected=lon_lat, hint=hint)


def _check_metres(system: Any, lons: Float64, lats: Float64, where: StrPath) -> None:
    """Refuse a system in which the places a metre east and north of the first are elsewhere."""
    on_earth = bool((np.abs(lons) <= 360.0).all() and (np.abs(lats) <= 90.0).all())
    _, _, apart_m = system.get_geod().inv(lons[[0, 0]], lats[[0, 0]], lons[1:], lats[1:])
    if on_earth and (np.abs(np.log(apart_m)) < np.log(_LARGEST_STRETCH)).all():
        return
    what = "a metre of the coordinate system is not one on the ground where the positions are"
    got = f"longitude {lons[0]:g}, latitude {lats[0]:g} in {system.srs}"
    expected = "a projected system, such as EPSG:25832"
    raise EvaluationError(what, where=where, got=got, expected=expected)


def las_record(
    laspy: Any, header: Any, cloud: PointCloud, T_to_from: Float64, ground: AreGround | None
) -> Any:
    """Return the points of a cloud as they are in a file with this header."""
    record = laspy.ScaleAwarePointRecord.zeros(len(cloud), header=header)
    record.return_number[:] = record.number_of_returns[:] = 1  # 0 is not permitted
    record.classification[:] = 1 if ground is None else np.where(ground(cloud), 2, 1)
    record.x, record.y, record.z = apply(T_to_from, cloud.xyz.astype(np.float64)).T
    for name, values in columns_of(cloud, "las").items():
        own = name in header.point_format.extra_dimension_names
        record[name] = values if own else values.astype(np.uint16) * _FULL_COLOUR
    return record
