"""Paths as files: that of a mapped drive, and that of one located in a map with its states."""

from __future__ import annotations

from collections.abc import Callable, Iterable
from contextlib import suppress
from dataclasses import replace
from pathlib import Path
from typing import Final

import numpy as np

from recon.core.geometry.se3 import invert, quaternion_from_rotation
from recon.core.values import Trajectory
from recon.core.values.arrays import Bool, Float64
from recon.io.atomic import write_text
from recon.io.fields import write_json
from recon.io.trajectory import write_kitti_poses, write_tum
from recon.map.localize.sequence import LocalizedDrive, LocalizedFrame
from recon.map.store.map_file import MapFile
from recon.map.store.session import Session
from recon.map.store.trees import loop_in
from recon.odometry.health import segment_numbers

_AXES: Final = ("x", "y", "z", "rx", "ry", "rz")
_POSE: Final = ("x_m", "y_m", "z_m", "qx", "qy", "qz", "qw")
_SIGMAS: Final = tuple(f"sigma_{axis}_{'rad' if 'r' in axis else 'm'}" for axis in _AXES)
_ENTRIES: Final = [(i, j) for i in range(6) for j in range(i, 6)]
_COVARIANCE: Final = tuple(f"cov_{_AXES[i]}_{_AXES[j]}" for i, j in _ENTRIES)
_UNKNOWN: Final = len(_POSE) + len(_SIGMAS) + len(_COVARIANCE)
HEADER: Final = (
    *("frame", "time_s", "state", "views", "inliers", "surfaces", "seconds"),
    *(*_POSE, *_SIGMAS, *_COVARIANCE),
)
_HEADING: Final = ",".join(HEADER) + "\n"


def export_paths(session: Session, joined: Bool, T_base_camera: Float64, folder: Path) -> None:
    """Write ``trajectory_*.txt`` of a drive, and ``loops.json`` if loops were closed.

    They have the frames that are joined (N,). Each other part of the drive between two breaks has
    ``segments/<number>/trajectory_tum.txt``, in axes of its own.
    """
    segment = segment_numbers(session.health)
    for number in np.unique(segment[~joined & (segment >= 0)]).tolist():
        apart = session.trajectory.select(segment == number)
        write_tum(folder / f"segments/{number}/trajectory_tum.txt", apart)
    path = session.trajectory.select(joined)
    write_kitti_poses(folder / "trajectory_kitti.txt", path)
    write_tum(folder / "trajectory_tum.txt", path)
    based = _of_base(path, session.T_map_world, T_base_camera)
    write_tum(folder / "trajectory_map_base_tum.txt", based)
    if session.loops.get("closed"):
        write_tum(folder / "trajectory_odometry_tum.txt", session.odometry.select(joined))
        loops = {
            kind: [
                {
                    "first": loop.first,
                    "last": loop.last,
                    "inliers": loop.inliers,
                    "dense_ratio": round(loop.dense_ratio, 4),
                    "T_first_last": loop.T_first_last.tolist(),
                }
                for loop in map(loop_in, session.loops[kind])
            ]
            for kind in ("closed", "refused")
        }
        write_json(folder / "loops.json", loops)


def export_sessions(map_: MapFile, folder: Path) -> None:
    """Write ``sessions/<number>/trajectory_*.txt`` of the linked drives, in the map's world."""
    for number, path in map_.paths.items():
        write_kitti_poses(folder / f"sessions/{number}/trajectory_kitti.txt", path)
        write_tum(folder / f"sessions/{number}/trajectory_tum.txt", path)


def export_localized(drive: LocalizedDrive, T_base_camera: Float64, folder: Path) -> None:
    """Write ``trajectory_tum.txt`` and ``trajectory_map_base_tum.txt``."""
    write_tum(folder / "trajectory_tum.txt", drive.trajectory)
    based = _of_base(drive.trajectory, drive.T_map_world, T_base_camera)
    write_tum(folder / "trajectory_map_base_tum.txt", based)


def write_states(path: Path, frames: Iterable[LocalizedFrame]) -> None:
    """Write a table with the state and the pose of each frame of a drive that was located."""
    write_text(path, "".join([_HEADING, *map(_line, frames)]))


def begin_states(path: Path) -> Callable[[LocalizedFrame], None]:
    """Begin such a table, and return what adds a frame to it, for those who look on."""
    write_states(path, ())

    def add(frame: LocalizedFrame) -> None:
        # It is no result: that the disk is full is said when there is one.
        with suppress(OSError), path.open("a", encoding="ascii") as table:
            table.write(_line(frame))

    return add


def _of_base(path: Trajectory, T_map_world: Float64, T_base_camera: Float64) -> Trajectory:
    """Return the path of the base of the vehicle, in map axes, from that of its camera."""
    T = T_map_world @ path.T_world_camera @ invert(T_base_camera)
    return replace(path, T_world_camera=T)


def _line(frame: LocalizedFrame) -> str:
    found, numbers = frame.located, [""] * _UNKNOWN
    words = [str(frame.index), f"{frame.time_s:.9f}", found.state.value]
    words += [str(found.views), str(found.inliers), str(int(found.surfaces))]
    words.append(f"{frame.seconds:.4f}")
    T, covariance = found.T_world_camera, found.covariance
    if T is not None and covariance is not None:
        pose = [*T[:3, 3], *quaternion_from_rotation(T[:3, :3])]
        spread = [*np.sqrt(np.diag(covariance)), *(covariance[i, j] for i, j in _ENTRIES)]
        numbers = [*(f"{value:.9f}" for value in pose), *(f"{value:.6e}" for value in spread)]
    return ",".join([*words, *numbers]) + "\n"
