"""A drive located in a map, as files: its path, and the state of each frame."""

from __future__ import annotations

from dataclasses import replace
from typing import Final

import numpy as np

from recon.core.geometry.se3 import invert, quaternion_from_rotation
from recon.core.values.arrays import Float64
from recon.io.atomic import write_text
from recon.io.trajectory import write_tum
from recon.map.ground.axes import base_axes
from recon.map.localize.sequence import LocalizedDrive, LocalizedFrame
from recon.run.directory import RunDirectory

_AXES: Final = ("x", "y", "z", "rx", "ry", "rz")
_POSE: Final = ("x_m", "y_m", "z_m", "qx", "qy", "qz", "qw")
_SIGMAS: Final = tuple(f"sigma_{axis}_{'rad' if 'r' in axis else 'm'}" for axis in _AXES)
_ENTRIES: Final = [(i, j) for i in range(6) for j in range(i, 6)]
_COVARIANCE: Final = tuple(f"cov_{_AXES[i]}_{_AXES[j]}" for i, j in _ENTRIES)
_UNKNOWN: Final = len(_POSE) + len(_SIGMAS) + len(_COVARIANCE)
HEADER: Final = (
    *("frame", "time_s", "state", "views", "inliers", "seconds"),
    *(*_POSE, *_SIGMAS, *_COVARIANCE),
)


def export_localized(
    drive: LocalizedDrive, camera_height_m: float | None, directory: RunDirectory
) -> None:
    """Write ``trajectory_tum.txt``, ``trajectory_map_base_tum.txt`` and ``states.csv``.

    Args:
        drive: The drive in the map.
        camera_height_m: Height of the map's camera above the ground; None = unknown.
        directory: The folder of the run.

    Raises:
        OutputError: A file cannot be written.
    """
    path, T_map_world = drive.trajectory, drive.T_map_world
    write_tum(directory.path("trajectory_tum.txt"), path)
    T_map_base = T_map_world @ path.T_world_camera @ invert(base_axes(T_map_world, camera_height_m))
    based = replace(path, T_world_camera=T_map_base)
    write_tum(directory.path("trajectory_map_base_tum.txt"), based)
    lines = [",".join(HEADER), *map(_line, drive.frames)]
    write_text(directory.path("states.csv"), "\n".join(lines) + "\n")


def _line(frame: LocalizedFrame) -> str:
    found = frame.located
    words = [str(frame.index), f"{frame.time_s:.9f}", found.state.value]
    words += [str(found.views), str(found.inliers), f"{frame.seconds:.4f}"]
    if found.T_world_camera is None or found.covariance is None:
        return ",".join([*words, *[""] * _UNKNOWN])
    return ",".join([*words, *_numbers(found.T_world_camera, found.covariance)])


def _numbers(T_world_camera: Float64, covariance: Float64) -> list[str]:
    """Return pose, standard deviations and the upper half of the covariance, row by row."""
    pose = [*T_world_camera[:3, 3], *quaternion_from_rotation(T_world_camera[:3, :3])]
    spread = [*np.sqrt(np.diag(covariance)), *(covariance[i, j] for i, j in _ENTRIES)]
    return [*(f"{value:.9f}" for value in pose), *(f"{value:.6e}" for value in spread)]
