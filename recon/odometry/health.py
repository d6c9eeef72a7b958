"""What the health of all poses says about a drive: which are trusted, and why others are not."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Final

import numpy as np
from numpy.typing import NDArray

from recon.core.text import counted, metres
from recon.core.values import RectifiedCamera, Trajectory
from recon.core.values.arrays import Bool
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
    poses = f"{len(bad)} of {counted(len(health), 'pose')} are not to be trusted"
    return [f"{poses} ({name_frames(bad)}): nothing of them is in the map"]


def name_frames(indices: Sequence[int]) -> str:
    """The segments of numbers in words, the first three of them."""
    named = [_frames(first, last) for first, last in _segments(indices)]
    return ", ".join([*named[:_NAMED], *(["…"] if len(named) > _NAMED else [])])


def health_warnings(health: Sequence[OdometryHealth]) -> list[str]:
    """One line per distinct warning, and per segment of frames without a trusted pose."""
    about: dict[str, list[int]] = {}
    for index, record in enumerate(health):
        for line in record.warnings:
            about.setdefault(line, []).append(index)
    lines = [f"{_frames(of[0], of[-1])}: {line}" for line, of in about.items()]
    bad = [index for index, record in enumerate(health) if not record.ok]
    for first, last in _segments(bad):
        why = "; ".join(dict.fromkeys(health[first].notes)) or "no reason recorded"
        where = _frames(first, last)
        lines.append(f"{where}: the pose is not to be trusted, nothing of it is mapped ({why})")
    return [*(doubt_about(health) if len(bad) > _MANY * len(health) else ()), *lines]


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
    stated = [(h.scale_px, h.sigma_m, h.sigma_deg) for h in health[1:]]
    figures = np.array(stated).reshape(-1, 3)
    known = np.isfinite(figures).all(axis=1) & trusted_poses(health[1:])
    length_m = float(steps_m[known].sum())
    if not length_m > 0.0:
        return None
    scale_px, sigma_m, sigma_deg = figures[known].T
    if rig_ratio is None:
        # An error of all disparities, also by the yaw, is a fraction of each.
        off_px = np.hypot(RIG_DISPARITY_PX, camera.focal_px * np.deg2rad(RIG_YAW_DEG))
        rig_ratio = float(steps_m[known] @ (off_px / scale_px) / length_m)
    rig = float(np.hypot(rig_ratio, RIG_BASELINE))
    # Errors of single steps: translations add up as they are; a turn moves all that follows, on
    # average a third of its square.
    segment_m = min(_SEGMENT_M, length_m)
    steps = segment_m / (length_m / float(known.sum()))
    moved = np.mean(sigma_m**2) + np.mean(np.deg2rad(sigma_deg) ** 2) * segment_m**2 / 3.0
    random = float(np.sqrt(steps * moved) / segment_m)
    rests_on_px = length_m / float(steps_m[known] @ (1.0 / scale_px))
    return ExpectedDrift(
        percent=100.0 * float(np.hypot(rig, random)),
        rig_percent=100.0 * rig,
        rests_on_m=camera.focal_px * camera.baseline_m / rests_on_px,
    )
