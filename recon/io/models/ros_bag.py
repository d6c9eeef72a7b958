"""Messages of ROS 2 in an MCAP file, which Foxglove and ``ros2 bag`` play (extra ``ros``)."""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from contextlib import contextmanager
from pathlib import Path
from typing import Any, Final

import numpy as np

from recon.core.errors import require
from recon.core.geometry.se3 import quaternion_from_rotation
from recon.core.values import PointCloud
from recon.core.values.arrays import Float64
from recon.io.atomic import writing_to
from recon.io.models.columns import columns_of, table_of

_EXTRA: Final = "ros"
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


class RosBag:
    """An open bag."""

    def __init__(self, writer: Any, store: Any, interfaces: Any) -> None:
        self._writer, self._store, self._interfaces = writer, store, interfaces
        self._topics: dict[str, Any] = {}

    def write(self, topic: str, time_ns: int, message: Message, *, kept: bool = False) -> None:
        """Write a message; ``kept`` = who subscribes late gets the last one of the topic, too."""
        kind, fields = message
        if topic not in self._topics:
            self._topics[topic] = self._writer.add_connection(
                topic, kind, typestore=self._store, offered_qos_profiles=self._quality(kept)
            )
        content = self._store.serialize_cdr(self._made(kind, fields), kind)
        self._writer.write(self._topics[topic], time_ns, content)

    def _quality(self, kept: bool) -> list[Any]:
        of = self._interfaces
        always, last = of.QosTime(0, 0), (of.QosHistory.KEEP_LAST, 1, of.QosReliability.RELIABLE)
        how = of.QosDurability.TRANSIENT_LOCAL, always, always, of.QosLiveliness.SYSTEM_DEFAULT
        return [of.Qos(*last, *how, always, False)] if kept else []

    def _made(self, kind: str, values: Mapping[str, Any]) -> Any:
        parts: dict[str, Any] = {}
        for name, (_, of) in self._store.fielddefs[kind][1]:
            value = values.get(name)
            if isinstance(of, str):
                value = self._made(of, value or {})
            elif isinstance(value, list) and isinstance(of[0][1], str):
                value = [self._made(of[0][1], one) for one in value]
            elif value is None:
                value = "" if of[0] == "string" else 0
            parts[name] = value
        return self._store.types[kind](**parts)


def header(frame: str, time_ns: int) -> dict[str, Any]:
    """Return a header: the frame of a message, and when it was measured."""
    seconds, left = divmod(time_ns, 1_000_000_000)
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


@contextmanager
def write_bag(folder: Path) -> Iterator[RosBag]:
    """Open a bag to be written: a new folder, in which a file of its name ends in ``.mcap``."""
    names = ("rosbag2", "interfaces", "typesys")
    rosbag2, interfaces, typesys = (require(f"rosbags.{name}", extra=_EXTRA) for name in names)
    store = typesys.get_typestore(typesys.Stores.ROS2_HUMBLE)
    for name, text in _GRID_MAP.items():
        store.register(typesys.get_types_from_msg(text, f"grid_map_msgs/msg/{name}"))
    # What is beside the file is of version 9, which ROS 2 reads since Iron.
    how = {"version": 9, "storage_plugin": rosbag2.StoragePlugin.MCAP}
    with writing_to(folder / f"{folder.name}.mcap"), rosbag2.Writer(folder, **how) as writer:
        yield RosBag(writer, store, interfaces)
