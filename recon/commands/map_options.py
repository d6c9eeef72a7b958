"""The options of `recon map` that are not part of the configuration."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

from recon.core.values import Trajectory
from recon.run.progress import SILENT, Progress


@dataclass(frozen=True)
class MapOptions:
    """Options of a run that are not part of the configuration.

    Attributes:
        command: Command name, for the record and the default folder.
        out: Result folder; None = a new one below ``outputs/``.
        threads: Threads to use; None = all cores. Changes no result.
        known_poses: Poses to use instead of odometry, one per frame.
        prior: Motion of the left camera from another sensor, in the time base of the source.
        prior_origin: Where it is from, for the summary.
        mesh: Whether to reconstruct a surface.
        progress: Shown how far the run is.
        audit: Whether a quick audit of the recording comes first, unless the settings forbid it.
        tell: Given the findings of the audit, before the drive is mapped.
        resume: Resume the unfinished run in ``out``.
        arguments: Command-line arguments, stored so that resuming need not repeat them.
    """

    command: str = "map"
    out: Path | None = None
    threads: int | None = None
    known_poses: Trajectory | None = None
    prior: Trajectory | None = None
    prior_origin: str = ""
    mesh: bool = True
    progress: Progress = SILENT
    audit: bool = True
    tell: Callable[[tuple[str, ...]], None] = lambda findings: None
    resume: bool = False
    arguments: Mapping[str, Any] = field(default_factory=dict)
