"""The figures of a run, as ``summary.json`` holds them and ``--json`` prints them."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import asdict, is_dataclass
from typing import Any, Final

from recon.odometry import OdometryHealth
from recon.pipeline.machine import peak_memory_mb
from recon.pipeline.stopwatch import Stopwatch

_MANY: Final = 0.1
"""Share of frames without a trusted pose above which the whole drive is in question."""


def plain(value: Any) -> Any:
    """Convert a value for JSON: dataclasses to mappings, NaN and infinity to None."""
    if is_dataclass(value) and not isinstance(value, type):
        return plain(asdict(value))
    if isinstance(value, dict):
        return {str(key): plain(item) for key, item in value.items()}
    if isinstance(value, list | tuple):
        return [plain(item) for item in value]
    if isinstance(value, float):
        return value if math.isfinite(value) else None
    return value


def cost(stopwatch: Stopwatch, total_seconds: float) -> dict[str, Any]:
    """Cost of a run: total seconds, seconds per stage (stages overlap), and peak memory."""
    return {
        "seconds": round(total_seconds, 3),
        "stages": {name: round(value, 3) for name, value in stopwatch.seconds.items()},
        "peak_memory_mb": round(peak_memory_mb(), 1),
    }


def health_warnings(health: Sequence[OdometryHealth]) -> list[str]:
    """One line per distinct warning, and per stretch of frames without a trusted pose."""
    told = dict.fromkeys(line for record in health for line in record.warnings)
    lines = [f"{_named(health, line)}: {line}" for line in told]
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
    """The range of frames that a warning is about, first to last."""
    about = [index for index, record in enumerate(health) if line in record.warnings]
    return _frames(about[0], about[-1])


def _frames(first: int, last: int) -> str:
    return f"frame {first}" if first == last else f"frames {first}-{last}"


def _stretches(indices: Sequence[int]) -> list[tuple[int, int]]:
    """Runs of consecutive numbers as (first, last)."""
    stretches: list[tuple[int, int]] = []
    for index in indices:
        if stretches and index == stretches[-1][1] + 1:
            stretches[-1] = (stretches[-1][0], index)
        else:
            stretches.append((index, index))
    return stretches
