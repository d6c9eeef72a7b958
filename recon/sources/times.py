"""Exposure times in the formats of the various layouts, and the true path at these times."""

from __future__ import annotations

import re
from collections.abc import Sequence
from pathlib import Path
from typing import Final

import numpy as np

from recon.core.errors import FormatError, SourceError
from recon.core.geometry.alignment import interpolate_poses, nearest_sorted
from recon.core.geometry.se3 import invert
from recon.core.text import counted, parse_integer, parse_number
from recon.core.values import SequenceTruth, Trajectory
from recon.core.values.arrays import Float64
from recon.io.files import read_lines, read_table, read_text, reader, seconds_of_date
from recon.io.trajectory import read_tum
from recon.sources.source import FrameList, check_most

_STAMP: Final = re.compile(r"\d{10}(\.\d+)?|\d{13}|\d{16}|\d{19}|\d+\.\d+", re.ASCII)
_SECONDS_DIGITS: Final = 10  # digits of a time in seconds since 1970, from 2001 to 2286
_LONGEST_STEP_S: Final = 60.0  # longest usual time between two frames of a drive
_CLOCK_STEPS: Final = 10  # least step of padded numbers that are a clock: 10 ms or finer


@reader
def read_times(path: Path, frames: int) -> Float64:
    """Return float64 (frames,), the times of the first frames; see `read_times_of_pairs`."""
    return read_times_of_pairs(path, FrameList([""] * frames, range(frames)))


def read_times_of_pairs(path: Path, listing: FrameList) -> Float64:
    """Return the increasing times of pairs: seconds, or number, seconds and exposure."""
    table, lines = read_table(path, (1, 3))
    seconds = table[:, table.shape[1] // 2]
    chosen = listing.lines(len(table))
    if chosen is None:
        what, got = "fewer times than images", counted(len(table), "time")
        raise SourceError(what, where=path, got=got, expected=f"{len(listing.names)}")
    check_seconds(seconds, path)
    times: Float64 = seconds[chosen]
    check_increasing(times, str(path), [lines[k] for k in chosen])
    return times


@reader
def read_dates(path: Path) -> Float64:
    """Read KITTI raw's date and time of day per line: float64 (N,), seconds since 1970."""
    lines = enumerate(read_text(path).splitlines(), start=1)
    return np.array([seconds_of_date(s, f"{path}:{n}") for n, s in lines if s.strip()])


@reader
def read_stamped_names(path: Path, *, unit_s: float = 1.0) -> list[tuple[float, str]]:
    """Read time [s] and file of each line of TUM's ``rgb.txt`` or EuRoC's ``data.csv`` (1e-9 s)."""
    entries = []
    for number, line in enumerate(read_lines(path), start=1):
        words = line.partition("#")[0].replace(",", " ").split()
        if not words:
            continue
        where, got = f"{path}:{number}", " ".join(words)[:60]
        try:
            stamp = parse_number(words[0]) if unit_s == 1 else parse_integer(words[0]) * unit_s
        except ValueError as error:
            raise FormatError("not a timestamp", where=where, got=words[0][:40]) from error
        if len(words) < 2 or not np.isfinite(stamp):
            raise FormatError("not a timestamp and a file name", where=where, got=got)
        entries.append((stamp, words[1]))
    if not entries:
        raise FormatError("file lists no images", where=path)
    check_increasing(np.array([stamp for stamp, _ in entries]), str(path))
    return entries


def truth_at(
    path: Trajectory, stamps_s: Float64, T_body_camera: Float64 | None = None
) -> tuple[SequenceTruth | None, str]:
    """Return the true pose of the left camera at some times, of a path ``T_world_body``.

    The first pose is the identity. If the path does not cover all times, there is a note instead.
    """
    covered = (stamps_s >= path.timestamps_s[0]) & (stamps_s <= path.timestamps_s[-1])
    if not covered.all():
        frames = counted(len(stamps_s), "frame")
        return None, f", ground truth for only {covered.sum()} of {frames}: not used"
    poses = interpolate_poses(path, stamps_s)
    if T_body_camera is not None:
        poses = poses @ T_body_camera
    return SequenceTruth(Trajectory(invert(poses[0]) @ poses, stamps_s)), ""


def read_tum_truth(folder: Path, stamps_s: Float64) -> tuple[SequenceTruth | None, str]:
    """Return the truth in ``groundtruth.txt`` (TUM format, left camera), if a folder has one."""
    path = folder / "groundtruth.txt"
    if not path.is_file():
        return None, ""
    return truth_at(read_tum(path), np.asarray(stamps_s))


def stamp_of_name(stem: str) -> float | None:
    """Return seconds in a file name, if any: as such, or an integer of ms, µs or ns since 1970."""
    if _STAMP.fullmatch(stem) is None:
        return None
    if "." in stem or len(stem) == _SECONDS_DIGITS:
        return float(stem)
    return float(int(stem) / 10 ** (len(stem) - _SECONDS_DIGITS))


def stamps_of_names(stems: Sequence[str]) -> Float64 | None:
    """Return the seconds in all file names of a camera; None = one has none, or counts."""
    stamps = [stamp_of_name(stem) for stem in stems]
    if any(stamp is None for stamp in stamps) or _are_counters(stems):
        return None
    return np.array(stamps, dtype=np.float64)


def _are_counters(stems: Sequence[str]) -> bool:
    """Return whether names with as many digits as a timestamp count frames."""
    if any("." in stem for stem in stems) or not stems[0].startswith("0"):
        return False
    steps = np.diff([int(stem) for stem in stems])
    return len(stems[0]) == _SECONDS_DIGITS or not steps.size or np.median(steps) < _CLOCK_STEPS


def check_increasing(stamps_s: Float64, where: str, lines: Sequence[int] | None = None) -> None:
    """Refuse times that do not increase; ``lines`` are those of the file that they are in."""
    backwards = np.flatnonzero(np.diff(stamps_s) <= 0)
    if backwards.size:
        at = int(backwards[0]) + 1
        still = stamps_s[at] == stamps_s[at - 1]
        what = "two images have the same timestamp" if still else "timestamps are out of order"
        place = f"{where}, image {at}" if lines is None else f"{where}:{lines[at]}"
        got = f"{stamps_s[at]:.6f} s after {stamps_s[at - 1]:.6f} s"
        hint = "the images of each camera must be in the order of their exposure"
        raise SourceError(what, where=place, got=got, hint=hint)


def check_seconds(stamps_s: Float64, where: str | Path) -> None:
    """Refuse times that cannot be seconds of a drive: milliseconds, or all the same."""
    step_s = float(np.median(np.diff(stamps_s))) if len(stamps_s) > 1 else 1.0
    if not 0.0 < step_s <= _LONGEST_STEP_S:
        what, got = "times are not those of a drive in seconds", f"{step_s:g} s from frame to frame"
        expected = f"more than 0, at most {_LONGEST_STEP_S:g} s"
        hint = "convert them; --set source.rate_hz= replaces those of a times.txt"
        raise SourceError(what, where=where, got=got, expected=expected, hint=hint)


def pair_stamps(
    left_s: Float64, right_s: Float64, tolerance_s: float, where: Path
) -> list[tuple[int | None, int | None]]:
    """Pair two increasing series: images that are nearest to each other, within the tolerance.

    Returns frames in order of time: the indices of left and right image, None = missing.
    """
    # Of two that are as near, a left image takes the first and a right one the last: else cameras
    # half a period apart would hardly have a pair.
    to_right = nearest_sorted(left_s, right_s)
    to_left = len(left_s) - 1 - nearest_sorted(-right_s, -left_s[::-1])
    mutual = to_left[to_right] == np.arange(len(left_s))
    apart_s = np.abs(right_s[to_right] - left_s)
    paired = mutual & (apart_s <= tolerance_s)
    if not paired.any():
        what = "no left and right images were taken at the same time"
        got, expected = f"at best {apart_s.min():.4g} s apart", f"at most {tolerance_s:g} s"
        hint = "raise --set source.tolerance_s= if that is the true skew of the cameras"
        raise SourceError(what, where=where, got=got, expected=expected, hint=hint)
    # Of two cameras with different rates, the slower one decides what is missing.
    check_most(int(paired.sum()), min(len(left_s), len(right_s)), where)
    rights = [
        right if pair else None for right, pair in zip(to_right.tolist(), paired, strict=True)
    ]
    alone = set(range(len(right_s))).difference(to_right[paired].tolist())
    frames: list[tuple[float, int | None, int | None]] = [
        *zip(left_s.tolist(), range(len(left_s)), rights, strict=True),
        *((float(right_s[k]), None, k) for k in sorted(alone)),
    ]
    return [frame[1:] for frame in sorted(frames, key=lambda frame: frame[0])]
