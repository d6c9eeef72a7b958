"""The results of a drive located in a map, and their figures."""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import Any

from recon.core.values import OccupancyGrid
from recon.map.localize.sequence import LocalizedDrive


@dataclass(frozen=True, eq=False)
class LocalizeRun:
    """Results of a run.

    Attributes:
        name: Display name of the source.
        map_name: Display name of the map.
        drive: Where its frames are in the map.
        grid: The grid of the map; None = the run of the map has none.
        summary: The figures of ``summary.json``.
    """

    name: str
    map_name: str
    drive: LocalizedDrive
    grid: OccupancyGrid | None
    summary: dict[str, Any] = field(default_factory=dict)
