"""Exposure times in the formats of the various layouts, and the true path at these times."""

from __future__ import annotations

import re
from collections.abc import Sequence
from dataclasses import dataclass
from datetime import datetime, timezone
from pathlib import Path
from typing import Final

import numpy as np

from recon.core.errors import FormatError, SourceError
from recon.core.geometry.alignment import interpolate_poses, nearest_sorted
from recon.core.geometry.se3 import invert
from recon.core.text import counted, parse_integer, parse_number
from recon.core.values import SequenceTruth, Trajectory
from recon.core.values.arrays import Float64
from recon.io.files import read_table, read_text, reader
from recon.io.trajectory import read_tum
from recon.sources.frame_list import FrameList


@reader
def read_times(path: Path, frames: int) -> Float64:
    """Read ``times.txt`` of the first frames, see `read_times_of_pairs`.

    Returns:
        float64 (frames,), increasing.
    """
    return read_times_of_pairs(path, FrameList([""] * frames, range(frames)))


def read_times_of_pairs(path: Path, listing: FrameList) -> Float64:
    """Read ``times.txt`` for the frames that are pairs; see `FrameList.lines`.

    A line per frame has its time in seconds, or, as for DSO, its number, time and exposure.

    Returns:
        float64, one time per pair, increasing.
    """
    if not path.exists():
        raise SourceError("file does not exist", where=path)
    table, lines = read_table(path, (1, 3))
    seconds = table[:, table.shape[1] // 2]
    chosen = listing.lines(len(table))
    if chosen is None:
        raise SourceError(
            "fewer times than images",
            where=path,
            got=counted(len(table), "time"),
            expected=f"{len(listing.names)}",
        )
    check_seconds(seconds, path)
    times: Float64 = seconds[chosen]
    check_increasing(times, str(path), [lines[k] for k in chosen])
    return times


@reader
def read_dates(path: Path) -> Float64:
    """Read KITTI raw's ``timestamps.txt``: a date and a time of day per line.

    Returns:
        float64 (N,), seconds since 1970, which a double resolves to 0.2 µs.
    """
    stamps = []
    for number, line in enumerate(read_text(path).splitlines(), start=1):
        if line.strip():
            stamps.append(_parse_date(line.strip(), f"{path}:{number}"))
    return np.array(stamps)


def _parse_date(text: str, where: str) -> float:
    # Python before 3.11 parses at most six decimals.
    whole, _, fraction = text.partition(".")
    try:
        whole.encode("ascii")
        day = datetime.strptime(whole, "%Y-%m-%d %H:%M:%S").replace(tzinfo=timezone.utc)
        return day.timestamp() + parse_number(f"0.{fraction or 0}")
    except ValueError as error:
        raise FormatError(
            "not a time", where=where, got=text[:40], expected="2011-09-26 13:02:25.964389445"
        ) from error


@reader
def read_stamped_names(path: Path, *, unit_s: float = 1.0) -> list[tuple[float, str]]:
    """Read a list of images: timestamp and file name per line, separated by spaces or a comma.

    Args:
        path: TUM's ``rgb.txt`` or EuRoC's ``data.csv``; ``#`` starts a comment.
        unit_s: Unit of the timestamps: 1e-9 for EuRoC.

    Returns:
        (seconds, name) of each line.
    """
    entries = []
    for number, line in enumerate(read_text(path).splitlines(), start=1):
        words = line.partition("#")[0].replace(",", " ").split()
        if words:
            entries.append(_parse_entry(words, unit_s, f"{path}:{number}"))
    if not entries:
        raise FormatError("file lists no images", where=path)
    return entries


def _parse_entry(words: list[str], unit_s: float, where: str) -> tuple[float, str]:
    try:
        stamp = parse_number(words[0]) if unit_s == 1 else parse_integer(words[0]) * unit_s
    except ValueError as error:
        raise FormatError("not a timestamp", where=where, got=words[0][:40]) from error
    if len(words) < 2 or not np.isfinite(stamp):
        raise FormatError("not a timestamp and a file name", where=where, got=" ".join(words)[:60])
    return stamp, words[1]


def truth_at(
    path: Trajectory, stamps_s: Float64, T_body_camera: Float64 | None = None
) -> tuple[SequenceTruth | None, str]:
    """Return the true pose of the left camera in each frame; the first one is the identity.

    Args:
        path: ``T_world_body`` at the times of the measuring instrument.
        stamps_s: float64 (N,), times of the frames.
        T_body_camera: float64 (4, 4), pose of the left camera in the body; None = identity.

    Returns:
        The ground truth and an empty note, or None and a note if it does not cover every frame.
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


_STAMP: Final = re.compile(r"\d{10}(\.\d+)?|\d{13}|\d{16}|\d{19}|\d+\.\d+", re.ASCII)

_SECONDS_DIGITS: Final = 10
"""Digits of a time in seconds since 1970, from 2001 to 2286."""
_LONGEST_STEP_S: Final = 60.0
"""Longest usual time between two frames of a drive."""
_CLOCK_STEPS: Final = 10
"""Least step of padded numbers that are a clock: 10 ms, or less in finer units."""


@dataclass(frozen=True, eq=False)
class StampPairs:
    """Pairs of entries of two series of timestamps.

    Attributes:
        left: Indices into the left series, increasing.
        right: Indices of their partners in the right series, increasing.
        alone: Numbers of entries (left, right) without a partner.
    """

    left: Sequence[int]
    right: Sequence[int]
    alone: tuple[int, int]


def stamp_of_name(stem: str) -> float | None:
    """Return timestamp in a file name: seconds, or an integer number of ms, µs or ns since 1970.

    Returns:
        Seconds, or None if the name is not a timestamp.
    """
    if _STAMP.fullmatch(stem) is None:
        return None
    if "." in stem or len(stem) == _SECONDS_DIGITS:
        return float(stem)
    return float(int(stem) / 10 ** (len(stem) - _SECONDS_DIGITS))


def stamps_of_names(stems: Sequence[str]) -> Float64 | None:
    """Return timestamps in the file names of one camera.

    Returns:
        float64 (N,), seconds; None unless all names are timestamps, or if they are counters, such
        as KITTI's ``0000000123``.
    """
    stamps = [stamp_of_name(stem) for stem in stems]
    if any(stamp is None for stamp in stamps) or _are_counters(stems):
        return None
    return np.array(stamps, dtype=np.float64)


def _are_counters(stems: Sequence[str]) -> bool:
    """Return whether names with as many digits as a timestamp count frames.

    Today's times have no leading zero. Those of a clock that starts at 0 may have one, but are
    many of their units (ms, µs or ns) apart, and no camera is timed in whole seconds.
    """
    if any("." in stem for stem in stems) or not stems[0].startswith("0"):
        return False
    steps = np.diff([int(stem) for stem in stems])
    return len(stems[0]) == _SECONDS_DIGITS or not steps.size or np.median(steps) < _CLOCK_STEPS


def check_increasing(stamps_s: Float64, where: str, lines: Sequence[int] | None = None) -> None:
    """Check that timestamps are strictly increasing.

    Args:
        stamps_s: float64 (N,), in the order of the frames.
        where: Their file or folder.
        lines: The line of each in the file; None = they are numbered.
    """
    backwards = np.flatnonzero(np.diff(stamps_s) <= 0)
    if backwards.size:
        at = int(backwards[0]) + 1
        still = stamps_s[at] == stamps_s[at - 1]
        raise SourceError(
            "two images have the same timestamp" if still else "timestamps are out of order",
            where=f"{where}, image {at}" if lines is None else f"{where}:{lines[at]}",
            got=f"{stamps_s[at]:.6f} s after {stamps_s[at - 1]:.6f} s",
            hint="the images of each camera must be in the order of their exposure",
        )


def check_seconds(stamps_s: Float64, where: str | Path) -> None:
    """Check that timestamps can be seconds of a drive, not milliseconds or all the same.

    Args:
        stamps_s: float64 (N,), in the order of the frames.
        where: Their file.
    """
    step_s = float(np.median(np.diff(stamps_s))) if len(stamps_s) > 1 else 1.0
    if not 0.0 < step_s <= _LONGEST_STEP_S:
        raise SourceError(
            "times are not those of a drive in seconds",
            where=where,
            got=f"{step_s:g} s from frame to frame",
            expected=f"more than 0, at most {_LONGEST_STEP_S:g} s",
            hint="convert them; --set source.rate_hz= replaces those of a times.txt",
        )


def pair_stamps(left_s: Float64, right_s: Float64, tolerance_s: float, where: str) -> StampPairs:
    """Pair two series of timestamps that are mutual nearest neighbours.

    Args:
        left_s: float64 (N,), seconds, increasing.
        right_s: float64 (M,), seconds, increasing.
        tolerance_s: Largest difference within a pair.
        where: The source, for the error message.
    """
    to_right, to_left = nearest_sorted(left_s, right_s), nearest_sorted(right_s, left_s)
    mutual = to_left[to_right] == np.arange(len(left_s))
    apart_s = np.abs(right_s[to_right] - left_s)
    chosen = np.flatnonzero(mutual & (apart_s <= tolerance_s))
    if not chosen.size:
        raise SourceError(
            "no left and right images were taken at the same time",
            where=where,
            got=f"at best {apart_s.min():.4g} s apart",
            expected=f"at most {tolerance_s:g} s",
            hint="raise --set source.tolerance_s= if that is the true skew of the cameras",
        )
    alone = (len(left_s) - len(chosen), len(right_s) - len(chosen))
    return StampPairs(chosen.tolist(), to_right[chosen].tolist(), alone)


def pairs_in_time(
    stamps_s: Sequence[Float64], pairs: StampPairs
) -> list[tuple[int | None, int | None]]:
    """Return all frames in order of time: indices of their left and right image, None = missing.

    Args:
        stamps_s: float64 (N,) and (M,), the two series.
        pairs: Which of their entries are pairs.
    """
    partner = dict(zip(pairs.left, pairs.right, strict=True))
    taken = set(pairs.right)
    frames: list[tuple[float, int | None, int | None]] = [
        (stamp_s, k, partner.get(k)) for k, stamp_s in enumerate(stamps_s[0].tolist())
    ]
    frames += [
        (stamp_s, None, k) for k, stamp_s in enumerate(stamps_s[1].tolist()) if k not in taken
    ]
    return [frame[1:] for frame in sorted(frames, key=lambda frame: frame[0])]
