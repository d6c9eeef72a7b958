"""Pose, time and health of each frame of a drive, in an append-only file."""

from __future__ import annotations

import json
import os
import zlib
from dataclasses import asdict
from pathlib import Path
from typing import Any, Final

import numpy as np

from recon.core.errors import FormatError
from recon.core.values import Trajectory
from recon.core.values.arrays import Float64
from recon.map.checkpoint import ANEW
from recon.odometry import OdometryHealth

_LOST: Final = "the frames of the unfinished run are missing or damaged"


class FrameLog:
    """Poses, times and health of the frames so far.

    `state` appends the frames since its last call, so that the cost per frame does not grow
    with the drive. A killed run may leave more frames in the file than its checkpoint counts;
    the next `state` cuts them off.

    Args:
        path: The file, one frame per line, in an existing folder. None = keep frames in memory.
    """

    def __init__(self, path: Path | None) -> None:
        self._path = path
        self._poses: list[Float64] = []
        self._times_s: list[float] = []
        self._health: list[OdometryHealth] = []
        self._written = [0, 0, 0]

    def __len__(self) -> int:
        return len(self._poses)

    @property
    def trajectory(self) -> Trajectory:
        """The poses so far, at least one."""
        return Trajectory(np.stack(self._poses), np.array(self._times_s))

    @property
    def health(self) -> tuple[OdometryHealth, ...]:
        """How far each pose can be trusted."""
        return tuple(self._health)

    def add(self, T_world_camera: Float64, time_s: float, health: OdometryHealth) -> None:
        """Add the next frame."""
        self._poses.append(T_world_camera)
        self._times_s.append(time_s)
        self._health.append(health)

    def state(self) -> list[int] | None:
        """Flush new frames to disk; return frames, bytes and checksum of the file, None if no file.

        Raises:
            OSError: The disk is full or cannot be written.
        """
        if self._path is None:
            return None
        frames, size, checksum = self._written
        lines = "".join(self._line(number) for number in range(frames, len(self))).encode()
        with self._path.open("r+b" if size else "wb") as file:
            file.truncate(size)
            file.seek(size)
            file.write(lines)
            file.flush()
            os.fsync(file.fileno())
        self._written = [len(self), size + len(lines), zlib.crc32(lines, checksum)]
        return self._written

    def restore(self, state: list[int] | None) -> None:
        """Resume from a `state`; later frames in the file are ignored.

        Raises:
            FormatError: The file is missing, truncated or damaged.
        """
        if self._path is None or state is None:
            return
        _, size, checksum = state
        try:
            with self._path.open("rb") as file:
                content = file.read(size)
        except OSError as error:
            raise FormatError(_LOST, where=self._path, got=error.strerror, hint=ANEW) from error
        if len(content) < size or zlib.crc32(content) != checksum:
            raise FormatError(_LOST, where=self._path, hint=ANEW)
        for line in content.splitlines():
            pose, time_s, health = json.loads(line)
            self.add(np.array(pose), time_s, _health(health))
        self._written = state

    def _line(self, number: int) -> str:
        """A frame as one line of text; floats are restored exactly."""
        health = asdict(self._health[number])
        record = [self._poses[number].tolist(), self._times_s[number], health]
        return json.dumps(record) + "\n"


def _health(record: dict[str, Any]) -> OdometryHealth:
    """A health record from the file, in which tuples became lists."""
    fields: dict[str, Any] = {k: tuple(v) if isinstance(v, list) else v for k, v in record.items()}
    return OdometryHealth(**fields)
