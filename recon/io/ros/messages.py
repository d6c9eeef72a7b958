"""Messages of ROS 2 that we write, as types and mappings of fields, and their bytes (CDR)."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from functools import cache
from typing import Any, Final, Protocol

import numpy as np

from recon.core.errors import FormatError, require
from recon.core.geometry.se3 import make_transform, quaternion_from_rotation
from recon.core.values import OccupancyGrid, PointCloud
from recon.core.values.arrays import Float64
from recon.io.models.columns import columns_of, table_of

NS_PER_S: Final = 1_000_000_000
# Numbers of types in a PointField.
_TYPES: Final = {"i1": 1, "u1": 2, "i2": 3, "u2": 4, "i4": 5, "u4": 6, "f4": 7, "f8": 8}
# Of grid_map_msgs for ROS 2, which rosbags does not bring.
_GRID_MAP: Final = {
    "GridMapInfo": "float64 resolution\nfloat64 length_x\nfloat64 length_y\n"
    "geometry_msgs/Pose pose",
    "GridMap": "std_msgs/Header header\ngrid_map_msgs/GridMapInfo info\nstring[] layers\n"
    "string[] basic_layers\nstd_msgs/Float32MultiArray[] data\nuint16 outer_start_index\n"
    "uint16 inner_start_index",
}
Message = tuple[str, Mapping[str, Any]]
"""Type and fields. Messages in it are mappings, too; numbers and texts left out are 0 or empty."""


class MessageWriter(Protocol):
    """Where messages go: a bag, or a network."""

    def write(self, topic: str, time_ns: int, message: Message, *, kept: bool = False) -> None:
        """Write a message; ``kept`` = who subscribes late gets the last one of the topic, too."""
        ...


@cache
def message_types() -> Any:
    """Return the definitions of messages of ROS 2, from rosbags (extra ``ros``)."""
    typesys = require("rosbags.typesys", extra="ros")
    store = typesys.get_typestore(typesys.Stores.ROS2_HUMBLE)
    for name, text in _GRID_MAP.items():
        store.register(typesys.get_types_from_msg(text, f"grid_map_msgs/msg/{name}"))
    return store


def encode(message: Message) -> bytes:
    """Return a message as it is sent and stored: CDR, little-endian, with its header."""
    kind, fields = message
    return bytes(message_types().serialize_cdr(_made(kind, fields), kind))


def _made(kind: str, values: Mapping[str, Any]) -> Any:
    store, parts = message_types(), dict[str, Any]()
    for name, (_, of) in store.fielddefs[kind][1]:
        value = values.get(name)
        if isinstance(of, str):
            value = _made(of, value or {})
        elif isinstance(value, list) and isinstance(of[0][1], str):
            value = [_made(of[0][1], one) for one in value]
        elif value is None:
            value = "" if of[0] == "string" else 0
        parts[name] = value
    return store.types[kind](**parts)


def stamp_of(time_s: float, where: str | None = None) -> int:
    """Return a time as messages have it, in nanoseconds, or `FormatError`."""
    if not 0.0 <= time_s < 2.0**31:
        what, got = "times of the frames do not fit into messages of ROS", f"{time_s:g} s"
        raise FormatError(what, where=where, got=got, expected="seconds since 1970")
    return round(NS_PER_S * time_s)


def header(frame: str, time_ns: int) -> dict[str, Any]:
    """Return a header: the frame of a message, and when it was measured."""
    seconds, left = divmod(time_ns, NS_PER_S)
    return {"frame_id": frame, "stamp": {"sec": seconds, "nanosec": left}}


def pose(T: Float64, place: str = "position", turn: str = "orientation") -> dict[str, Any]:
    """Return a pose (4, 4); or a transform, which has other names for its parts."""
    xyzw = quaternion_from_rotation(T[:3, :3]).tolist()
    parts = zip("xyz", T[:3, 3].tolist(), strict=True), zip("xyzw", xyzw, strict=True)
    return {place: dict(parts[0]), turn: dict(parts[1])}


def points(head: Mapping[str, Any], cloud: PointCloud) -> Message:
    """Return a cloud: x, y, z and, if known, what `ATTRIBUTES` say."""
    rows = table_of(cloud.xyz, columns_of(cloud, "ros"))
    fields = [
        {"name": name, "offset": at, "datatype": _TYPES[kind.str[1:]], "count": 1}
        for name, (kind, at, *_) in (rows.dtype.fields or {}).items()
    ]
    size = rows.itemsize
    content = {
        "header": head, "height": 1, "width": len(rows), "is_dense": True, "fields": fields,
        "point_step": size, "row_step": size * len(rows), "data": rows.view(np.uint8).reshape(-1),
    }  # fmt: skip
    return "sensor_msgs/msg/PointCloud2", content


def transforms(time_ns: int, edges: Sequence[tuple[str, str, Float64]]) -> Message:
    """Return where frames lie: parent, child, and ``T_parent_child`` of each."""
    made = [
        {"header": header(parent, time_ns), "child_frame_id": child,
         "transform": pose(T, "translation", "rotation")}
        for parent, child, T in edges
    ]  # fmt: skip
    return "tf2_msgs/msg/TFMessage", {"transforms": made}


def grid_message(time_ns: int, grid: OccupancyGrid) -> Message:
    """Return a grid or costs, in map axes; what is below 0 is unknown (-1)."""
    rows, columns = grid.cells.shape
    corner = make_transform(np.eye(3), np.array([*grid.origin_m, 0.0]))
    size = {"width": columns, "height": rows, "resolution": grid.resolution_m}
    content = {
        "info": {**size, "map_load_time": {}, "origin": pose(corner)},
        "data": np.maximum(grid.cells, -1).ravel(),
    }
    return "nav_msgs/msg/OccupancyGrid", {"header": header("map", time_ns), **content}
