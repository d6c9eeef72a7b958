"""Segments of a path, over which its drift is measured, as in the KITTI development kit."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Final

import numpy as np

from recon.core.errors import EvaluationError
from recon.core.values.arrays import Float64, Int32

KITTI_LENGTHS_M: Final = (100.0, 200.0, 300.0, 400.0, 500.0, 600.0, 700.0, 800.0)
"""Segment lengths of the KITTI benchmark."""

SHORT_LENGTHS_M: Final = (50.0, 100.0)
"""Segment lengths for a drive that is too short for two lengths of the benchmark."""

KITTI_STEP_FRAMES: Final = 10
"""The benchmark starts a segment at every tenth frame (one second)."""


@dataclass(frozen=True, eq=False)
class Segments:
    """Segments of the true path.

    Attributes:
        first: int32 (N,), first frame of each segment.
        last: int32 (N,), last frame of each segment.
        length_m: float64 (N,), nominal length of each segment.
    """

    first: Int32
    last: Int32
    length_m: Float64


def choose_segments(
    distances_m: Float64,
    lengths_m: tuple[float, ...] | None = None,
    step_frames: int | None = None,
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
