"""What the health of all poses says about a drive: which are trusted, and why others are not."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Final

import numpy as np
from numpy.typing import NDArray

from recon.core.values.arrays import Bool
from recon.core.words import counted
from recon.odometry.protocol import OdometryHealth

_MANY: Final = 0.1
"""Share of frames without a trusted pose above which the whole drive is in question."""

_NAMED: Final = 3
"""Stretches of frames that a line names."""


def trusted_poses(health: Sequence[OdometryHealth]) -> Bool:
    """Return bool (N,), which poses are to be trusted."""
    return np.array([record.ok for record in health], np.bool_)


def stretches(health: Sequence[OdometryHealth]) -> NDArray[np.int64]:
    """Return int64 (N,), the stretch of each frame: in one, poses are measured from one another.

    A new one begins after a pose that is not to be trusted, unless that was skipped: where it lies
    beside the one before is a guess. -1 = the pose itself is not to be trusted.
    """
    found, number, lost = [], 0, False
    for record in health:
        if not record.ok:
            lost |= not record.skipped
        elif lost:
            number, lost = number + 1, False
        found.append(number if record.ok else -1)
    return np.array(found, np.int64)


def doubt_about(health: Sequence[OdometryHealth]) -> list[str]:
    """Return one line about a drive with poses that are not to be trusted; empty = it has none."""
    bad = [index for index, record in enumerate(health) if not record.ok]
    if len(bad) > _MANY * len(health):
        poses = f"the poses of {len(bad)} of {counted(len(health), 'frame')} are not"
        follows = "an error once made stays in all that follows"
        return [f"PATH AND MAP ARE NOT TO BE TRUSTED: {poses}, and {follows}"]
    if not bad:
        return []
    poses = (
        f"{len(bad)} of {counted(len(health), 'pose')} are not to be trusted ({name_frames(bad)})"
    )
    guessed = ", and what follows may be misplaced" if stretches(health).max() > 0 else ""
    return [f"{poses}: nothing of them is in the map{guessed}"]


def name_frames(indices: Sequence[int]) -> str:
    """Return the stretches of numbers in words, the first three of them."""
    named = [_frames(first, last) for first, last in _stretches(indices)]
    return ", ".join([*named[:_NAMED], *(["…"] if len(named) > _NAMED else [])])


def health_warnings(health: Sequence[OdometryHealth]) -> list[str]:
    """Return one line per distinct warning, and per stretch of frames without a trusted pose."""
    texts = dict.fromkeys(line for record in health for line in record.warnings)
    lines = [f"{_named(health, line)}: {line}" for line in texts]
    bad = [index for index, record in enumerate(health) if not record.ok]
    for first, last in _stretches(bad):
        why = "; ".join(dict.fromkeys(health[first].notes)) or "no reason recorded"
        where = _frames(first, last)
        lines.append(f"{where}: the pose is not to be trusted, nothing of it is mapped ({why})")
    return [*(doubt_about(health) if len(bad) > _MANY * len(health) else ()), *lines]


def _named(health: Sequence[OdometryHealth], line: str) -> str:
    """Return the range of frames that a warning is about, first to last."""
    about = [index for index, record in enumerate(health) if line in record.warnings]
    return _frames(about[0], about[-1])


def _frames(first: int, last: int) -> str:
    return f"frame {first}" if first == last else f"frames {first}-{last}"


def _stretches(indices: Sequence[int]) -> list[tuple[int, int]]:
    """Return runs of consecutive numbers as (first, last)."""
    stretches: list[tuple[int, int]] = []
    for index in indices:
        if stretches and index == stretches[-1][1] + 1:
            stretches[-1] = (stretches[-1][0], index)
        else:
            stretches.append((index, index))
    return stretches
