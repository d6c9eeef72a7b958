"""What the health of all poses says about a drive: which are trusted, and why others are not."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Final

import numpy as np

from recon.core.values.arrays import Bool
from recon.odometry.protocol import OdometryHealth

_MANY: Final = 0.1
"""Share of frames without a trusted pose above which the whole drive is in question."""


def trusted_poses(health: Sequence[OdometryHealth]) -> Bool:
    """Return bool (N,), which poses are to be trusted."""
    return np.array([record.ok for record in health], np.bool_)


def health_warnings(health: Sequence[OdometryHealth]) -> list[str]:
    """Return one line per distinct warning, and per stretch of frames without a trusted pose."""
    texts = dict.fromkeys(line for record in health for line in record.warnings)
    lines = [f"{_named(health, line)}: {line}" for line in texts]
    bad = [index for index, record in enumerate(health) if not record.ok]
    for first, last in _stretches(bad):
        why = "; ".join(dict.fromkeys(health[first].notes)) or "no reason recorded"
        where = _frames(first, last)
        lines.append(f"{where}: the pose is not to be trusted, nothing of it is mapped ({why})")
    if len(bad) > _MANY * len(health):
        lines.insert(
            0,
            f"PATH AND MAP ARE NOT TO BE TRUSTED: the poses of {len(bad)} of {len(health)} frames "
            "are not, and an error once made stays in all that follows",
        )
    return lines


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
