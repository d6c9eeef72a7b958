"""Messages of ROS 2 in an MCAP file, which Foxglove and ``ros2 bag`` play (extra ``ros``)."""

from __future__ import annotations

import time
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any, Final

from recon.core.errors import require
from recon.io.atomic import writing_to
from recon.io.ros.messages import Message, encode, message_types

_FLUSH_S: Final = 1.0


class RosBag:
    """An open bag; one written ``as_it_goes`` is on disk each second, if the program is killed."""

    def __init__(self, writer: Any, interfaces: Any, *, as_it_goes: bool = False) -> None:
        self._writer, self._interfaces = writer, interfaces
        self._topics: dict[str, Any] = {}
        self._as_it_goes, self._flushed_s = as_it_goes, time.monotonic()

    def write(self, topic: str, time_ns: int, message: Message, *, kept: bool = False) -> None:
        """Write a message; ``kept`` = who subscribes late gets the last one of the topic, too."""
        kind, _ = message
        if topic not in self._topics:
            self._topics[topic] = self._writer.add_connection(
                topic, kind, typestore=message_types(), offered_qos_profiles=self._quality(kept)
            )
        self._writer.write(self._topics[topic], time_ns, encode(message))
        if self._as_it_goes and time.monotonic() - self._flushed_s >= _FLUSH_S:
            self._flushed_s, file = time.monotonic(), self._writer.storage
            file.close_chunk()
            file.bio.flush()

    def _quality(self, kept: bool) -> list[Any]:
        of = self._interfaces
        always, last = of.QosTime(0, 0), (of.QosHistory.KEEP_LAST, 1, of.QosReliability.RELIABLE)
        how = of.QosDurability.TRANSIENT_LOCAL, always, always, of.QosLiveliness.SYSTEM_DEFAULT
        return [of.Qos(*last, *how, always, False)] if kept else []


@contextmanager
def write_bag(folder: Path, *, as_it_goes: bool = False) -> Iterator[RosBag]:
    """Open a bag to be written: a new folder, in which a file of its name ends in ``.mcap``."""
    rosbag2, interfaces = (
        require(f"rosbags.{name}", extra="ros") for name in ("rosbag2", "interfaces")
    )
    # What is beside the file is of version 9, which ROS 2 reads since Iron.
    how = {"version": 9, "storage_plugin": rosbag2.StoragePlugin.MCAP}
    with writing_to(folder / f"{folder.name}.mcap"), rosbag2.Writer(folder, **how) as writer:
        yield RosBag(writer, interfaces, as_it_goes=as_it_goes)
