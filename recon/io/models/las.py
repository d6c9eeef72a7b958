"""Point clouds for surveying programs (extra ``survey``): LAS, LAZ, COPC and E57 files."""

from __future__ import annotations

import struct
from collections.abc import Callable, Iterable, Iterator
from contextlib import contextmanager
from os import SEEK_END
from pathlib import Path
from typing import Any, Final
from uuid import uuid4

import numpy as np

from recon.core.errors import EvaluationError, SettingsError, require
from recon.core.geometry.se3 import apply
from recon.core.kernels.voxels import KEY_BITS, pack_keys
from recon.core.values import PointCloud
from recon.core.values.arrays import Float64, Int64, UInt8
from recon.io.atomic import atomic_path
from recon.io.files import StrPath
from recon.io.models.columns import columns_of, with_first

_EXTRA: Final = "survey"
COLOURED: Final = 7  # point format with colours, of LAS 1.4
_STEP_M: Final = 0.001
_MARGIN_DEG: Final = 6.0  # systems are used as far outside their area as a zone of UTM is wide
_LARGEST_STRETCH: Final = 2.0  # of a metre on the ground: Mercator's at 60 degrees north
_FULL_COLOUR: Final = 257  # colours have 16 bits: 255 becomes 65535
UNCLASSIFIED, GROUND, ABOVE_GROUND = 1, 2, 64  # ASPRS leaves classes from 64 on to users
Classify = Callable[[PointCloud], UInt8]
"""Returns the class of each point of a cloud, uint8 (N,)."""


def write_las(
    path: StrPath,
    clouds: Iterable[PointCloud],
    T_to_from: Float64,
    crs: str | None = None,
    step_m: float = _STEP_M,
    classify: Classify | None = None,
) -> int:
    """Write clouds into one LAS 1.4 file, atomically, compressed in ``.laz``; returns their points.

    Positions are rounded to ``step_m``; colours and, as extra dimensions, what else `ATTRIBUTES`
    say are those of the first cloud. ``T_to_from`` (4, 4) leads to the coordinates of the file, in
    the system ``crs``. Without ``classify`` all points are unclassified; those that are inferred
    have the flag of synthetic ones.

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
            file.write_points(las_record(laspy, header, cloud, T_to_from, classify))
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
    """Return the header of a file as `write_las` describes it."""
    header = laspy.LasHeader(point_format=COLOURED, version="1.4")
    header.generating_software = "recon"
    header.global_encoding.wkt = True  # as the format of its points needs, even without a system
    header.scales, header.offsets = np.full(3, step_m), np.floor(T_to_from[:3, 3])
    for each, _ in first.attributes:
        if each.las and each.width == 1:
            header.add_extra_dim(laspy.ExtraBytesParams(*each.las, each.dtype, each.about))
    names = laspy.vlrs.known.ClassificationLookupVlr()
    names.lookups = dict.fromkeys(range(256), "") | {ABOVE_GROUND: "above ground"}
    header.vlrs.append(names)
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
        what = "the coordinate system has no easting and northing in metres"
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
    got = f"easting {position_m[0]:.9g}, northing {position_m[1]:.9g} in {crs}"
    lon_lat = f"longitude {area.west:g} to {area.east:g}, latitude {area.south:g} to {area.north:g}"
    hint = "are they easting, then northing, in metres of this system?"
    raise EvaluationError(what, where=where, got=got, expected=lon_lat, hint=hint)


def _check_metres(system: Any, lons: Float64, lats: Float64, where: StrPath) -> None:
    """Refuse a system in which the places a metre east and north of the first are elsewhere."""
    on_earth = bool((np.abs(lons) <= 360.0).all() and (np.abs(lats) <= 90.0).all())
    _, _, apart_m = system.get_geod().inv(lons[[0, 0]], lats[[0, 0]], lons[1:], lats[1:])
    if on_earth and (np.abs(np.log(apart_m)) < np.log(_LARGEST_STRETCH)).all():
        return
    what = "the coordinate system distorts lengths where the positions are"
    got = f"longitude {lons[0]:g}, latitude {lats[0]:g} in {system.srs}"
    expected = "a projected system, such as EPSG:25832"
    raise EvaluationError(what, where=where, got=got, expected=expected)


def las_record(
    laspy: Any, header: Any, cloud: PointCloud, T_to_from: Float64, classify: Classify | None
) -> Any:
    """Return the points of a cloud as they are in a file with this header."""
    record = laspy.ScaleAwarePointRecord.zeros(len(cloud), header=header)
    record.return_number[:] = record.number_of_returns[:] = 1  # 0 is not permitted
    record.classification[:] = UNCLASSIFIED if classify is None else classify(cloud)
    record.synthetic[:] = 0 if cloud.inferred is None else cloud.inferred
    record.x, record.y, record.z = apply(T_to_from, cloud.xyz.astype(np.float64)).T
    for name, values in columns_of(cloud, "las").items():
        own = name in header.point_format.extra_dimension_names
        record[name] = values if own else values.astype(np.uint16) * _FULL_COLOUR
    return record


_CELL_BITS: Final = 7
NODE_CELLS: Final = 1 << _CELL_BITS  # of a node of an octree, along each side
_INFO: Final = struct.Struct("<5d2Q2d88x")  # the first record of the file
_INFO_AT: Final = 375 + 54  # behind the header of LAS 1.4 and that of the record
_LONG: Final = struct.Struct("<2x16sHQ32s")  # the header of a record behind the points
_ENTRY: Final = np.dtype(
    [("node", "<i4", 4), ("offset", "<u8"), ("bytes", "<i4"), ("points", "<i4")]
)


def write_copc(
    path: StrPath,
    clouds: Iterable[PointCloud],
    T_to_from: Float64,
    crs: str | None = None,
    *,
    step_m: float,
    classify: Classify | None = None,
) -> int:
    """Write clouds into one COPC file as `write_las` does, with all points in memory.

    Ref: https://copc.io, version 1.0.
    """
    laspy, lazrs = require("laspy", extra=_EXTRA), require("lazrs", extra=_EXTRA)
    first, clouds = with_first(clouds)
    header = las_header(laspy, first, T_to_from, crs, step_m)
    records = [las_record(laspy, header, cloud, T_to_from, classify) for cloud in clouds]
    points = laspy.ScaleAwarePointRecord.empty(header=header)
    points.array = np.concatenate([points.array, *(one.array for one in records)])
    steps = np.stack([points.array[axis] for axis in "XYZ"], axis=1).astype(np.int64)
    low, high = (steps.min(axis=0), steps.max(axis=0)) if len(steps) else np.zeros((2, 3), int)
    # The cube is no larger than its longest side: there are readers that take that for granted.
    side = max(1, int((high - low).max()))
    nodes, parts = octree(steps - low, side)
    packed = lazrs.LazVlr.new_for_compression(COLOURED, points.point_format.num_extra_bytes, True)
    info = laspy.VLR("copc", 1, "", bytes(_INFO.size))
    header.update(points)
    header.vlrs[:0] = [info, laspy.vlrs.known.LasZipVlr(packed.record_data())]
    header.are_points_compressed, header.number_of_evlrs = True, 1
    with packing(path) as temporary, temporary.open("w+b") as file:
        header.write_to(file)
        packer = lazrs.ParLasZipCompressor(file, packed)
        packer.compress_chunks([np.frombuffer(points.array[one], np.uint8) for one in parts])
        packer.done()
        header.start_of_first_evlr = file.seek(0, SEEK_END)
        file.seek(header.offset_to_point_data)
        entries = np.zeros(len(nodes), _ENTRY)
        entries["points"], entries["bytes"] = np.array(lazrs.read_chunk_table(file, packed)).T
        # A chunk begins where those before it end, the first behind where their table is.
        ends = header.offset_to_point_data + 8 + np.cumsum(entries["bytes"])
        entries["node"], entries["offset"] = nodes, ends - entries["bytes"]
        file.seek(header.start_of_first_evlr)
        file.write(_LONG.pack(b"copc", 1000, entries.nbytes, b"") + entries.tobytes())
        file.seek(0)
        header.write_to(file, ensure_same_size=True)
        half_m, hierarchy_at = step_m * side / 2, header.start_of_first_evlr + _LONG.size
        cube = *(header.offsets + step_m * low + half_m), half_m, 2 * half_m / (1 << _CELL_BITS)
        file.seek(_INFO_AT)
        file.write(_INFO.pack(*cube, hierarchy_at, entries.nbytes, 0.0, 0.0))
    return len(points)


def octree(
    steps: Int64, side: int, depths: int = KEY_BITS - _CELL_BITS
) -> tuple[Int64, list[Int64]]:
    """Return the nodes (K, 4), depth and cell, of points (N, 3) in a cube, and the rows of each.

    A node has the first of the points left in each of its cells, the deepest ones all. Positions
    are in steps, of which a side of the cube has so many.
    """
    nodes, left = np.zeros((len(steps), 4), np.int64), np.arange(len(steps))
    for depth in range(depths):
        bits = depth + _CELL_BITS
        cells = np.minimum((steps[left] << bits) // side, (1 << bits) - 1)
        nodes[left, 0], nodes[left, 1:] = depth, cells >> _CELL_BITS
        _, first = np.unique(pack_keys(cells), return_index=True)
        left = np.delete(left, first)
    order = np.lexsort(nodes.T[::-1])
    nodes = nodes[order]
    begins = np.flatnonzero(np.diff(nodes, axis=0, prepend=-1).any(axis=1))
    return nodes[begins], np.split(order, begins[1:])


_AXES: Final = ("cartesianX", "cartesianY", "cartesianZ")


def write_e57(
    path: StrPath, clouds: Iterable[PointCloud], T_to_from: Float64, crs: str | None = None
) -> int:
    """Write clouds into one E57 file, atomically, each as a scan; returns the number of points.

    Positions are doubles from an offset of whole metres, the pose of each scan, so that programs
    that round to single precision keep millimetres. ``T_to_from`` (4, 4) and ``crs`` are as in
    `write_las`.

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
