"""Text with a line per frame: trajectories of KITTI and TUM, and lists of image pairs."""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Final

import numpy as np

from recon.core.errors import FormatError
from recon.core.geometry.se3 import (
    make_transform,
    orthonormalise,
    quaternion_from_rotation,
    rotation_from_quaternion,
)
from recon.core.text import counted, parse_number
from recon.core.values import Trajectory
from recon.core.values.arrays import Float64
from recon.io.atomic import write_text
from recon.io.files import StrPath, read_table, read_text, reader

# Files print rotations with four to seven digits; a larger deviation means it is not a rotation.
_RIGID_TOLERANCE = 1e-3
_UNIT_TOLERANCE = 1e-2
# Geocentric and projected map coordinates stay below 1e7 m.
_FARTHEST_M = 1e8
FRAMES: Final = "frames.csv"
HEADER: Final = "# left image, right image, left time [s], right time [s]\n"


@reader
def read_trajectory(path: StrPath, timestamps_s: Float64 | None = None) -> Trajectory:
    """Read a KITTI or TUM trajectory, recognised by the number of columns (12 or 8).

    TUM files contain their times; ``timestamps_s``, float64 (N,), are those of a KITTI file. A file
    that is damaged, or has another number of poses than times, is a `FormatError`.
    """
    table, lines = read_table(path, (12, 8))
    if table.shape[1] == 12:
        return _from_kitti(table, lines, path, timestamps_s)
    return _from_tum(table, lines, path)


@reader
def holds_times(path: StrPath) -> bool:
    """Return whether a trajectory file has timestamps: TUM files do, KITTI files do not."""
    return bool(read_table(path, (12, 8))[0].shape[1] == 8)


@reader
def read_kitti_poses(path: StrPath, timestamps_s: Float64 | None = None) -> Trajectory:
    """Read poses, a row-major 3×4 matrix per line; without times, pose ``i`` gets ``i`` seconds."""
    return _from_kitti(*read_table(path, (12,)), path, timestamps_s)


@reader
def read_tum(path: StrPath) -> Trajectory:
    """Read timestamped poses, ``t tx ty tz qx qy qz qw`` per line."""
    return _from_tum(*read_table(path, (8,)), path)


def write_kitti_poses(path: StrPath, trajectory: Trajectory) -> None:
    """Write poses in KITTI's format, 13 digits, atomically; it has no timestamps."""
    rows = trajectory.T_world_camera[:, :3, :].reshape(-1, 12)
    write_text(path, "".join(" ".join(f"{value:.12e}" for value in row) + "\n" for row in rows))


def write_tum(path: StrPath, trajectory: Trajectory) -> None:
    """Write poses in TUM's format, 12 decimals (9 for the time), ``qw ≥ 0``, atomically."""
    lines = []
    for T, time_s in zip(trajectory.T_world_camera, trajectory.timestamps_s, strict=True):
        numbers = [*T[:3, 3], *quaternion_from_rotation(T[:3, :3])]
        text = " ".join(f"{number:.12f}" for number in numbers)
        lines.append(f"{float(time_s):.9f} {text}\n")
    write_text(path, "".join(lines))


def _from_kitti(
    table: Float64, lines: list[int], path: StrPath, timestamps_s: Float64 | None
) -> Trajectory:
    times = np.arange(len(table), dtype=np.float64) if timestamps_s is None else timestamps_s
    if len(times) != len(table):
        what, got = "numbers of poses and timestamps differ", counted(len(table), "pose")
        raise FormatError(what, got=got, expected=f"{len(times)}")
    check_positions(table[:, 3::4], lines, path)
    poses = np.zeros((len(table), 4, 4))
    poses[:, :3, :] = table.reshape(-1, 3, 4)
    poses[:, 3, 3] = 1.0
    for pose, line in zip(poses, lines, strict=True):
        R = pose[:3, :3]
        orthonormal = np.allclose(R @ R.T, np.eye(3), rtol=0, atol=_RIGID_TOLERANCE)
        if not orthonormal or np.linalg.det(R) < 0:
            what = "pose is not a rigid transform"
            expected = "a row-major 3x4 matrix of rotation and translation"
            raise FormatError(what, where=f"{path}:{line}", expected=expected)
    return Trajectory(np.stack([orthonormalise(pose) for pose in poses]), times)


def _from_tum(table: Float64, lines: list[int], path: StrPath) -> Trajectory:
    check_positions(table[:, 1:4], lines, path)
    norms = np.linalg.norm(table[:, 4:], axis=1)
    for norm, line in zip(norms, lines, strict=True):
        if abs(norm - 1) > _UNIT_TOLERANCE:
            what = "quaternion is not of unit length"
            raise FormatError(what, where=f"{path}:{line}", got=f"{norm:g}")
    backwards = np.diff(table[:, 0]) < 0
    if backwards.any():
        line = lines[int(np.argmax(backwards)) + 1]
        raise FormatError("time runs backwards", where=f"{path}:{line}")
    poses = [make_transform(rotation_from_quaternion(row[4:]), row[1:4]) for row in table]
    return Trajectory(np.stack(poses), table[:, 0].copy())


def check_positions(xyz_m: Float64, lines: list[int], path: StrPath) -> None:
    """Refuse positions (N, 3) that are nowhere on Earth; ``lines`` are theirs in the file."""
    far_m = np.abs(xyz_m).max(axis=1)
    worst = int(np.argmax(far_m))
    if far_m[worst] > _FARTHEST_M:
        what = "position is implausibly far from the origin"
        got, expected = f"{far_m[worst]:.3g} m", f"at most {_FARTHEST_M:.0e} m"
        raise FormatError(what, where=f"{path}:{lines[worst]}", got=got, expected=expected)


@dataclass(frozen=True)
class CapturedFrame:
    """A pair of images, relative to the folder of their list, and their times."""

    left: str
    right: str
    left_s: float
    right_s: float

    def line(self) -> str:
        return f"{self.left},{self.right},{self.left_s:.6f},{self.right_s:.6f}\n"


@reader
def read_frames(path: StrPath) -> list[CapturedFrame]:
    """Read ``frames.csv``: pairs with their times; a line is written after both of its images."""
    lines = enumerate(read_text(path).splitlines(), start=1)
    frames = [_parse(line, f"{path}:{n}") for n, line in lines if line and line[0] != "#"]
    if not frames:
        raise FormatError("file lists no images", where=path)
    return frames


def _parse(line: str, where: str) -> CapturedFrame:
    words = [word.strip() for word in line.split(",")]
    try:
        left, right, left_s, right_s = words
        times = parse_number(left_s), parse_number(right_s)
    except ValueError as error:
        raise FormatError("not two images and their times", where=where, got=line[:60]) from error
    if not all(math.isfinite(time) for time in times):
        raise FormatError("time is not finite", where=where, got=line[:60])
    return CapturedFrame(left, right, *times)
