"""Exposure times in the formats of the various layouts, and the true path at these times."""

from __future__ import annotations

from datetime import datetime, timezone
from pathlib import Path

import numpy as np

from recon.core.decimals import parse_integer, parse_number
from recon.core.errors import FormatError, SourceError
from recon.core.geometry.interpolation import interpolate_poses
from recon.core.geometry.se3 import invert
from recon.core.values import SequenceTruth, Trajectory
from recon.core.values.arrays import Float64
from recon.core.words import counted
from recon.io.files import read_table, read_text, reader
from recon.io.trajectory import read_tum
from recon.sources.frame_list import FrameList
from recon.sources.stamps import check_increasing, check_seconds


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
