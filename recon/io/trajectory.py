"""Text with a line per frame: trajectories of KITTI and TUM, and lists of image pairs."""

from __future__ import annotations

import math
import re
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Final, Literal, NamedTuple

import numpy as np

from recon.core.errors import FormatError, OutputError
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
from recon.io.files import StrPath, parse_row, read_lines, read_table, read_text, reader

# Files print rotations with four to seven digits; a larger deviation means it is not a rotation.
_RIGID_TOLERANCE = 1e-3
UNIT_TOLERANCE = 1e-2
# Geocentric and projected map coordinates stay below 1e7 m.
_FARTHEST_M = 1e8
_EUROC_COLUMNS: Final = 17  # time, pose, velocity and biases
_EUROC_ORDER: Final = [0, 1, 2, 3, 5, 6, 7, 4]  # its quaternion is w x y z
_COLUMNS: Final = ("t", "x", "y", "z", "qx", "qy", "qz", "qw")  # of TUM
# A row of data begins with a number; lines before the first may be a header.
_DATA: Final = re.compile(r"\s*[\"']?[-+.]?\d", re.ASCII)
_IN_BRACKETS: Final = re.compile(r"(?<!\s)\s*[\[(]([^][()]*)[\])]")
_LONGEST: Final = 80  # letters of a name that are looked at: what they mean stands at its end
#: Names of times, quaternions and places, in lower case: of EuRoC, TUM, and what ROS exports.
_SIGNS: Final = (
    re.compile(r"%?(.*[._])?(t|time\w*|stamp(_[num]?s)?)"),
    re.compile(r"(.*[._])?(q|quat\w*|orientation|rot\w*)([._]\w*)?[._]?[xyzw]"),
    re.compile(r"((.*[._])?(t|p|pos|position|trans|translation)([._]\w*)?[._]?)?[xyz]"),
)
_UNIT: Final = re.compile(r"[_[]([nuµm]?)s(ec\w*)?$")
_UNITS_S: Final = {"n": 1e-9, "u": 1e-6, "µ": 1e-6, "m": 1e-3, "": 1.0}
_SINCE_1970_S: Final = (1e9, 4e9)  # from 2001 to 2096
_STEP_S: Final = 3600.0  # more is not between poses of one drive
# Vehicles slip sideways by less; an order that is wrong gives twice the angle that they turn by.
_WANDERS_RAD: Final = np.radians(5.0)
_MUCH: Final = 3.0
_NAMES: Final = ("tx", "ty", "tz", "qx", "qy", "qz", "qw")
ORDER_HINT: Final = "a first line '# timestamp tx ty tz qw qx qy qz' tells the order of a file"
FRAMES: Final = "frames.csv"
HEADER: Final = "# left image, right image, left time [s], right time [s]\n"


@reader
def read_trajectory(path: StrPath, timestamps_s: Float64 | None = None) -> Trajectory:
    """Read a KITTI trajectory (12 columns), or one with times, see `read_tum`.

    ``timestamps_s``, float64 (N,), are those of a KITTI file. A damaged file is a `FormatError`.
    """
    rows = _read_rows(path, (12, 8, _EUROC_COLUMNS))
    timed = rows.table.shape[1] == 8
    return _from_tum(rows, path) if timed else _from_kitti(rows, path, timestamps_s)


@reader
def holds_times(path: StrPath) -> bool:
    """Return whether a trajectory file has timestamps: all but KITTI's do."""
    return bool(_read_rows(path, (12, 8, _EUROC_COLUMNS)).table.shape[1] == 8)


@reader
def read_kitti_poses(path: StrPath, timestamps_s: Float64 | None = None) -> Trajectory:
    """Read poses, a row-major 3×4 matrix per line; without times, pose ``i`` gets ``i`` seconds."""
    return _from_kitti(Rows(*read_table(path, (12,))), path, timestamps_s)


@reader
def read_tum(path: StrPath) -> Trajectory:
    """Read timestamped poses, ``t tx ty tz qx qy qz qw`` per line, or as a header names them.

    So tables of EuRoC (which need none), motion capture and ROS are read. Times are seconds, or in
    the unit that the header states; since 1970 they may be milli-, micro- or nanoseconds.

    Raises:
        FormatError: A row is no pose; or, without a header, ``qw qx qy qz`` is clearly meant.
    """
    return _from_tum(_read_rows(path, (8, _EUROC_COLUMNS)), path)


def write_trajectory(
    path: StrPath, trajectory: Trajectory, form: Literal["tum", "kitti"] = "tum"
) -> None:
    """Write a trajectory atomically, as TUM has it or, without times, KITTI.

    Raises:
        OutputError: There is no such format or no pose, or the file cannot be written.
    """
    if form not in ("tum", "kitti"):
        what, expected = "unknown format of a trajectory", "tum or kitti"
        raise OutputError(what, where=path, got=form, expected=expected)
    if not len(trajectory):
        raise OutputError("the trajectory has no pose", where=path)
    if form == "kitti":
        write_kitti_poses(path, trajectory)
    else:
        write_tum(path, trajectory, f"# timestamp {' '.join(_NAMES)}\n")


def write_kitti_poses(path: StrPath, trajectory: Trajectory) -> None:
    """Write poses in KITTI's format, 13 digits, atomically; it has no timestamps."""
    rows = trajectory.T_world_camera[:, :3, :].reshape(-1, 12)
    write_text(path, "".join(" ".join(f"{value:.12e}" for value in row) + "\n" for row in rows))


def write_tum(path: StrPath, trajectory: Trajectory, head: str = "") -> None:
    """Write poses in TUM's format, 12 decimals (9 for the time), ``qw ≥ 0``, atomically."""
    lines = [head]
    for T, time_s in zip(trajectory.T_world_camera, trajectory.timestamps_s, strict=True):
        numbers = [*T[:3, 3], *quaternion_from_rotation(T[:3, :3])]
        text = " ".join(f"{number:.12f}" for number in numbers)
        lines.append(f"{float(time_s):.9f} {text}\n")
    write_text(path, "".join(lines))


class Rows(NamedTuple):
    """Numbers of a trajectory file, (N, 12) of KITTI or (N, 8) in the order of TUM."""

    table: Float64
    lines: Sequence[int]
    named: bool = False  # whether the file itself tells the order


def _read_rows(path: StrPath, counts: tuple[int, ...]) -> Rows:
    """Read what a header names, else rows of as many columns as permitted; times in seconds."""
    texts = [text.partition("#") for text in read_lines(path)]
    first = next((n for n, (text, *_) in enumerate(texts) if _DATA.match(text)), len(texts))
    heads = (_columns_of(text or comment) for text, _, comment in texts[:first])
    head = next(filter(None, heads), None)
    if head is None or first == len(texts):
        table, lines = read_table(path, counts)
        if table.shape[1] == 12:
            return Rows(table, lines)
        head = (_EUROC_ORDER, 1e-9) if table.shape[1] == _EUROC_COLUMNS else None
        table = table if head is None else table[:, _EUROC_ORDER]
    else:
        lines = [n + 1 for n, (text, *_) in enumerate(texts) if n >= first and text.strip()]
        rows = [_parts(texts[n - 1][0]) for n in lines]
        picked = ([row[n] for n in head[0] if n < len(row)] for row in rows)
        places = (f"{path}:{line}" for line in lines)
        table = np.array([parse_row(row, (8,), at) for row, at in zip(picked, places, strict=True)])
    stated_s = None if head is None else head[1]
    table[:, 0] *= stated_s or _unit_of(table[:, 0])
    return Rows(table, lines, head is not None)


def _parts(line: str) -> list[str]:
    """Split a line at its semicolons, else at tabs, commas or spaces."""
    mark = next((mark for mark in ";\t," if mark in line), None)
    return [word.strip(" \"'") for word in line.strip().split(mark)]


def _columns_of(head: str) -> tuple[list[int], float | None] | None:
    """Return where a header has the columns of TUM, and the unit of times; None = it has not."""
    names = _parts(_IN_BRACKETS.sub(lambda unit: f"[{unit[1].replace(' ', '')}", head.lower()))
    found: dict[str, int] = {}
    for number, name in enumerate(names):
        signs = (sign.fullmatch(name.partition("[")[0][-_LONGEST:]) for sign in _SIGNS)
        kind = next((kind for kind, sign in zip(("t", "q", ""), signs, strict=True) if sign), None)
        if kind is not None:
            found.setdefault(kind if kind == "t" else kind + name.partition("[")[0][-1], number)
    if not found.keys() >= set(_COLUMNS):
        return None
    unit = _UNIT.search(names[found["t"]])
    return [found[name] for name in _COLUMNS], None if unit is None else _UNITS_S[unit[1]]


def _unit_of(times: Float64) -> float:
    """Return the seconds of a unit in which times since 1970 are counted, else 1."""
    step = float(np.median(np.diff(times))) if len(times) > 1 else 0.0
    for unit_s in (1e-3, 1e-6, 1e-9):
        # Nanoseconds since a computer was started may look like milliseconds since 1970.
        if _SINCE_1970_S[0] <= times[0] * unit_s < _SINCE_1970_S[1] and step * unit_s < _STEP_S:
            return unit_s
    return 1.0


def _from_kitti(rows: Rows, path: StrPath, timestamps_s: Float64 | None) -> Trajectory:
    table, lines, _ = rows
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


def _from_tum(rows: Rows, path: StrPath) -> Trajectory:
    table, lines, named = rows
    check_positions(table[:, 1:4], lines, path)
    norms = np.linalg.norm(table[:, 4:], axis=1)
    for norm, line in zip(norms, lines, strict=True):
        if abs(norm - 1) > UNIT_TOLERANCE:
            what = "quaternion is not of unit length"
            raise FormatError(what, where=f"{path}:{line}", got=f"{norm:g}")
    backwards = np.diff(table[:, 0]) < 0
    if backwards.any():
        line = lines[int(np.argmax(backwards)) + 1]
        raise FormatError("time runs backwards", where=f"{path}:{line}")
    poses = [make_transform(rotation_from_quaternion(row[4:]), row[1:4]) for row in table]
    trajectory = Trajectory(np.stack(poses), table[:, 0].copy())
    if not named:
        _check_order(trajectory, path)
    return trajectory


def reordered(path: Trajectory) -> Trajectory:
    """Return a path whose quaternions were ``w x y z``, and were read as ``x y z w``."""
    poses = path.T_world_camera.copy()
    for pose in poses:
        pose[:3, :3] = rotation_from_quaternion(np.roll(quaternion_from_rotation(pose[:3, :3]), -1))
    return Trajectory(poses, path.timestamps_s)


def _check_order(path: Trajectory, where: StrPath) -> None:
    """Refuse orientations that the path follows only with their quaternions in the other order."""
    # A rig that moves along one of its own directions does so in one order alone, once it turns; of
    # one that stands, goes straight or is carried anyhow, both orders say the same.
    apart_rad, other_rad = _wander_rad(path), _wander_rad(reordered(path))
    if apart_rad > max(_WANDERS_RAD, _MUCH * other_rad):
        apart, other = (f"{np.degrees(angle):.1f} deg" for angle in (apart_rad, other_rad))
        raise FormatError(
            "the quaternions are not in the order of TUM",
            where=where,
            got=f"motions that differ by {apart} from one direction of the rig, and by {other} "
            "as qw qx qy qz",
            expected="t tx ty tz qx qy qz qw",
            hint=ORDER_HINT,
        )


def _wander_rad(path: Trajectory) -> float:
    """Return by how much directions of motion differ (RMS), in axes of the rig, by length."""
    poses = path.T_world_camera
    steps_m = np.diff(path.positions_m, axis=0)
    turned_m = np.einsum("nji,nj->ni", poses[:-1, :3, :3], steps_m)
    length_m = float(np.linalg.norm(steps_m, axis=1).sum())
    ratio = float(np.linalg.norm(turned_m.sum(axis=0))) / length_m if length_m > 0 else 1.0
    return float(np.sqrt(2.0 * max(0.0, 1.0 - ratio)))  # 1 - cos, for small angles


def check_positions(xyz_m: Float64, lines: Sequence[int], path: StrPath) -> None:
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
