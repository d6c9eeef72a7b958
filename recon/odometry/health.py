"""What the health of all poses says about a drive: which are trusted, and why others are not."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Final

import numpy as np
from numpy.typing import NDArray

from recon.core.text import counted, metres
from recon.core.values import RectifiedCamera, Trajectory
from recon.core.values.arrays import Bool, Float64
from recon.odometry.checked import SegmentCounter
from recon.odometry.protocol import OdometryHealth

_MANY: Final = 0.1
"""Fraction of frames without a trusted pose above which the whole drive is in question."""

_NAMED: Final = 3  # segments of frames that a line names


def trusted_poses(health: Sequence[OdometryHealth]) -> Bool:
    """Return bool (N,), which poses are to be trusted."""
    return np.array([record.ok for record in health], np.bool_)


def segment_numbers(health: Sequence[OdometryHealth]) -> NDArray[np.int64]:
    """The segment (N,) of each frame, by `SegmentCounter`."""
    counter = SegmentCounter()
    return np.array([counter.add(record) for record in health], np.int64)


def doubt_about(health: Sequence[OdometryHealth]) -> list[str]:
    """One line about a drive with poses that are not to be trusted; empty = it has none."""
    bad = [index for index, record in enumerate(health) if not record.ok]
    if len(bad) > _MANY * len(health) and not all(health[index].skipped for index in bad):
        poses = f"the poses of {len(bad)} of {counted(len(health), 'frame')} are not"
        return [f"PATH AND MAP ARE NOT TO BE TRUSTED: {poses}"]
    if not bad:
        return []
    poses = (
        f"{len(bad)} of {counted(len(health), 'pose')} are not to be trusted ({name_frames(bad)})"
    )
    return [f"{poses}: nothing of them is in the map"]


def name_frames(indices: Sequence[int]) -> str:
    """The segments of numbers in words, the first three of them."""
    named = [_frames(first, last) for first, last in _segments(indices)]
    return ", ".join([*named[:_NAMED], *(["…"] if len(named) > _NAMED else [])])


def health_warnings(health: Sequence[OdometryHealth]) -> list[str]:
    """One line per distinct warning, and per segment of frames without a trusted pose."""
    texts = dict.fromkeys(line for record in health for line in record.warnings)
    lines = [f"{_named(health, line)}: {line}" for line in texts]
    bad = [index for index, record in enumerate(health) if not record.ok]
    for first, last in _segments(bad):
        why = "; ".join(dict.fromkeys(health[first].notes)) or "no reason recorded"
        where = _frames(first, last)
        lines.append(f"{where}: the pose is not to be trusted, nothing of it is mapped ({why})")
    return [*(doubt_about(health) if len(bad) > _MANY * len(health) else ()), *lines]


def _named(health: Sequence[OdometryHealth], line: str) -> str:
    """The range of frames that a warning is about, first to last."""
    about = [index for index, record in enumerate(health) if line in record.warnings]
    return _frames(about[0], about[-1])


def _frames(first: int, last: int) -> str:
    return f"frame {first}" if first == last else f"frames {first}-{last}"


def _segments(indices: Sequence[int]) -> list[tuple[int, int]]:
    """Runs of consecutive numbers as (first, last)."""
    segment_numbers: list[tuple[int, int]] = []
    for index in indices:
        if segment_numbers and index == segment_numbers[-1][1] + 1:
            segment_numbers[-1] = (segment_numbers[-1][0], index)
        else:
            segment_numbers.append((index, index))
    return segment_numbers


RIG_DISPARITY_PX: Final = 0.1
"""Standard deviation of an error common to all disparities, of a rig that was calibrated well."""

RIG_YAW_DEG: Final = 0.02
"""That of the angle between the cameras, which shifts all disparities, too."""

RIG_BASELINE: Final = 0.002  # that of the baseline, as a fraction of it
_SEGMENT_M: Final = 100.0
"""Length over which the drift is stated, or the path if it is shorter: errors of the heading make
it grow with the length."""

_SIGMAS: Final = 1.96  # half width of a 95 % interval, in standard deviations
_MOST_PERCENT: Final = 3.0
"""Half width of that interval above which the length of a path is in question."""


@dataclass(frozen=True)
class ExpectedDrift:
    """Standard deviation of a position after a segment of the path, per cent of its length."""

    percent: float  # all of it
    rig_percent: float  # the part that is due to the rig, common to the whole path: its length
    rests_on_m: float  # distance of the points on which the length rests

    @property
    def radius_ratio(self) -> float:
        """Where a position is with 95 % probability: within this fraction of the path up to it."""
        return _SIGMAS * self.percent / 100.0

    def warnings(self) -> list[str]:
        """A warning if the length of the path is not certain."""
        half_width = _SIGMAS * self.rig_percent
        if half_width <= _MOST_PERCENT:
            return []
        where = f"scale rests on points about {metres(self.rests_on_m)} away"
        return [f"{where}: the length of the path is certain to ± {half_width:.0f} % only"]


def expected_drift(
    path: Trajectory,
    health: Sequence[OdometryHealth],
    camera: RectifiedCamera,
    rig_ratio: float | None = None,
) -> ExpectedDrift | None:
    """How far a path by odometry may be off; None where no motion was measured.

    ``rig_ratio`` is the standard deviation of its length that the drive leaves to the rig, as a
    share; None = nothing is known of the rig, it counts as calibrated well. Frames without a
    trusted pose do not count: `health_warnings` names them.
    """
    steps_m = np.linalg.norm(np.diff(path.positions_m, axis=0), axis=1)
    figures = np.array([(h.scale_px, h.sigma_m, h.sigma_deg) for h in health[1:]])
    known = np.isfinite(figures).all(axis=1) if len(figures) else np.zeros(0, np.bool_)
    known &= np.array([h.ok for h in health[1:]], dtype=np.bool_)
    length_m = float(steps_m[known].sum())
    if not length_m > 0.0:
        return None
    scale_px, sigma_m, sigma_deg = figures[known].T
    if rig_ratio is None:
        rig_ratio = float(steps_m[known] @ _scale_ratio(scale_px, camera) / length_m)
    rig = float(np.hypot(rig_ratio, RIG_BASELINE))
    step_m = length_m / float(known.sum())
    random = _random_ratio(step_m, length_m, sigma_m, np.deg2rad(sigma_deg))
    rests_on_px = length_m / float(steps_m[known] @ (1.0 / scale_px))
    return ExpectedDrift(
        percent=100.0 * float(np.hypot(rig, random)),
        rig_percent=100.0 * rig,
        rests_on_m=camera.focal_px * camera.baseline_m / rests_on_px,
    )


def _scale_ratio(scale_px: Float64, camera: RectifiedCamera) -> Float64:
    """What an error of all disparities does to the lengths (N,) of steps, as a share."""
    yaw_px = camera.focal_px * np.deg2rad(RIG_YAW_DEG)
    return np.asarray(np.hypot(RIG_DISPARITY_PX, yaw_px) / scale_px)


def _random_ratio(step_m: float, length_m: float, sigma_m: Float64, sigma_rad: Float64) -> float:
    """What errors of single steps add up to over a segment, as a fraction of its length.

    Translations add as they are; a turn moves all that follows, on average a third of its square.
    """
    segment_m = min(_SEGMENT_M, length_m)
    steps = segment_m / step_m
    moved = np.mean(sigma_m**2) + np.mean(sigma_rad**2) * segment_m**2 / 3.0
    return float(np.sqrt(steps * moved) / segment_m)
