"""The poses and the health of the frames of a session, as records of a map."""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import fields
from typing import Any, Final

import numpy as np

from recon.core.errors import FormatError
from recon.core.values import Trajectory
from recon.core.values.arrays import Float64, array_in
from recon.map.store.values import value_in
from recon.odometry.protocol import OdometryHealth

FRAMES: Final = "frames"
FARTHEST_M: Final = 1e5
"""From the start: farther than any drive, or ray."""
_SKEW: Final = 1e-3
"""Of poses that were written with few digits."""
_HEALTH: Final = tuple(f.name for f in fields(OdometryHealth))


def frames_record(
    poses: Sequence[Float64], times_s: Sequence[float], health: Sequence[OdometryHealth]
) -> dict[str, Any]:
    """Return consecutive frames as a tree of arrays and plain values."""
    return {
        "T_world_camera": np.stack(poses),
        "times_s": np.array(times_s),
        "health": {name: [getattr(one, name) for one in health] for name in _HEALTH},
    }


def frames_in(content: Mapping[str, Any]) -> Iterator[tuple[Float64, float, OdometryHealth]]:
    """Yield pose, time and health of each frame in what `frames_record` gave."""
    times_s = array_in(content, "times_s", np.float64, (None,))
    path, columns = path_of(content["T_world_camera"], times_s), content["health"]
    for number, (T, time_s) in enumerate(zip(path.T_world_camera, times_s.tolist(), strict=True)):
        # Older versions measured more.
        values = {name: columns[name][number] for name in _HEALTH}
        yield T, time_s, value_in(OdometryHealth, values)


def path_of(poses: Float64, times_s: Float64) -> Trajectory:
    """Return a path of poses that were read, maybe from a file with few digits."""
    path = Trajectory(array_in({"poses": poses}, "poses", np.float64, (None, 4, 4)), times_s)
    R = path.T_world_camera[:, :3, :3]
    skew = np.abs(R @ R.transpose(0, 2, 1) - np.eye(3)).max(axis=(1, 2))
    far_m = np.abs(path.positions_m).max(axis=1)
    wrong = (skew > _SKEW) | (far_m > FARTHEST_M) | (np.linalg.det(R) <= 0)
    wrong |= (path.T_world_camera[:, 3] != (0, 0, 0, 1)).any(axis=1)
    if wrong.any():
        raise FormatError("the path of the map has an impossible pose", got=int(np.argmax(wrong)))
    return path
