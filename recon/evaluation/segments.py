"""Which poses of two paths are compared: near in time, at the ends of segments, measured."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Final

import numpy as np

from recon.core.errors import EvaluationError
from recon.core.geometry.alignment import nearest_sorted
from recon.core.geometry.se3 import angle_rad, invert
from recon.core.text import counted
from recon.core.values import Trajectory
from recon.core.values.arrays import Bool, Float64, Int32

# Segment lengths of the KITTI benchmark.
KITTI_LENGTHS_M: Final = (100.0, 200.0, 300.0, 400.0, 500.0, 600.0, 700.0, 800.0)
# Segment lengths for a drive that is too short for two lengths of the benchmark.
SHORT_LENGTHS_M: Final = (50.0, 100.0)
KITTI_STEP_FRAMES: Final = 10  # the benchmark starts a segment at every tenth frame (one second)


@dataclass(frozen=True, eq=False)
class Segments:
    """Segments of the true path."""

    first: Int32  # (N,), first frame of each segment
    last: Int32  # (N,), last frame of each segment
    length_m: Float64  # (N,), nominal length of each segment


def choose_segments(
    distances_m: Float64, lengths_m: tuple[float, ...] | None = None, step_frames: int | None = None
) -> Segments:
    """Choose the segments over which a drive is evaluated.

    Args:
        distances_m: float64 (N,), true path length from the first pose to each pose.
        lengths_m: Segment lengths; None = those of the benchmark that fit, or shorter ones.
        step_frames: Frames between starts; None = 10, or 1 for shorter lengths.
    """
    if lengths_m is not None:
        segments = segments_of(distances_m, lengths_m, step_frames or KITTI_STEP_FRAMES)
        if not len(segments.first):
            raise EvaluationError(
                "true path has no room for a segment of the requested lengths",
                got=f"a path of {distances_m[-1]:.1f} m",
                expected=f"more than {min(lengths_m):g} m",
            )
        return segments
    segments = segments_of(distances_m, KITTI_LENGTHS_M, step_frames or KITTI_STEP_FRAMES)
    if len(np.unique(segments.length_m)) >= 2:
        return segments
    segments = segments_of(distances_m, SHORT_LENGTHS_M, step_frames or 1)
    if len(segments.first):
        return segments
    return segments_of(distances_m, (0.5 * float(distances_m[-1]),), 1)


def segments_of(distances_m: Float64, lengths_m: tuple[float, ...], step: int) -> Segments:
    """Return segments of given lengths from every ``step``-th frame, where the path has room.

    As in the development kit, a segment ends at the first frame whose distance along the path
    exceeds its length.
    """
    starts = np.arange(0, len(distances_m), step)
    first = np.repeat(starts, len(lengths_m))
    length_m = np.tile(np.asarray(lengths_m, dtype=np.float64), len(starts))
    last = np.searchsorted(distances_m, distances_m[first] + length_m, side="right")
    fits = last < len(distances_m)
    return Segments(first[fits].astype(np.int32), last[fits].astype(np.int32), length_m[fits])


# Largest time difference of two associated poses, unless another is given.
TOLERANCE_S: Final = 0.01


def associate(
    estimate: Trajectory, truth: Trajectory, tolerance_s: float
) -> tuple[Trajectory, Trajectory]:
    """Match poses that are mutually nearest in time; poses without a match are left out.

    Both paths are on the same clock, their rates may differ. Those returned are of equal length.
    """
    there = nearest_sorted(estimate.timestamps_s, truth.timestamps_s)
    back = nearest_sorted(truth.timestamps_s, estimate.timestamps_s)
    apart_s = np.abs(truth.timestamps_s[there] - estimate.timestamps_s)
    mutual = (back[there] == np.arange(len(estimate))) & (apart_s <= tolerance_s)
    if not mutual.any():
        spans = [
            f"{t[0]:.3f} to {t[-1]:.3f} s" for t in (estimate.timestamps_s, truth.timestamps_s)
        ]
        raise EvaluationError(
            "no poses of the two trajectories match in time",
            got=f"times {' and '.join(spans)}",
            expected=f"times within {tolerance_s:g} s of each other",
            hint="raise --tolerance, or make sure that both use the same clock",
        )
    return estimate.select(mutual), truth.select(there[mutual])


# A turn changes evenly from frame to frame if it does so less than this share of the median.
_EVEN: Final = 0.02
_LEAST_CHANGES: Final = 5  # fewer even changes in a row may be chance
# Where turns change less than this everywhere, the digits of the file decide: KITTI has six.
_LEAST_MEDIAN_RAD: Final = 5e-5


def interpolated_poses(path: Trajectory) -> Bool:
    """Return bool (N,): poses along which the path turns at one rate, as it does nowhere else.

    A vehicle never does for more than a moment: its rates of turn change from frame to frame. A
    path that turns evenly for the most part has none, as rendered ones do. Times are about equal.
    """
    found = np.zeros(len(path), np.bool_)
    if len(path) < _LEAST_CHANGES + 2:
        return found
    step = invert(path.T_world_camera[:-1]) @ path.T_world_camera[1:]
    change = angle_rad(invert(step[:-1]) @ step[1:])
    typical = float(np.median(change))
    even = (change < _EVEN * typical) & (typical > _LEAST_MEDIAN_RAD)
    runs = np.lib.stride_tricks.sliding_window_view(even, _LEAST_CHANGES).all(axis=1)
    for first in np.flatnonzero(runs):
        found[first : first + _LEAST_CHANGES + 2] = True
    return found


def interpolation_warnings(truth: Trajectory, segments: Segments) -> list[str]:
    """Return what to know of relative errors: how many rest on poses that nobody measured."""
    found = interpolated_poses(truth)
    if not found.any():
        return []
    resting = int((found[segments.first] | found[segments.last]).sum())
    first, last = np.flatnonzero(found)[[0, -1]]
    which = f"{counted(int(found.sum()), 'true pose')} (between {first} and {last})"
    where = f"{resting} of {counted(len(segments.first), 'segment')} begin or end there"
    return [f"{which} turn evenly, as interpolated ones do: {where}"]
