"""Where a run works: what it may keep on the disk, and who times it."""

from __future__ import annotations

from dataclasses import dataclass, field
from pathlib import Path

from recon.pipeline.stopwatch import Stopwatch


@dataclass(frozen=True)
class Workspace:
    """What a drive is mapped with, apart from what decides the result.

    Attributes:
        stopwatch: Told the seconds per stage.
        folder: Where closed submaps are written, so that memory does not grow with the drive; it
            must stay as long as the result is used. None = they stay in memory.
    """

    stopwatch: Stopwatch = field(default_factory=Stopwatch)
    folder: Path | None = None
