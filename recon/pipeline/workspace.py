"""Where a run works: what it keeps on the disk while it lasts, and who times it."""

from __future__ import annotations

from dataclasses import dataclass, field
from pathlib import Path
from typing import Final

from recon.pipeline.checkpoint import Checkpoint
from recon.pipeline.stopwatch import Stopwatch

RAYS: Final = "rays.bin"


@dataclass(frozen=True)
class Workspace:
    """What a drive is mapped with, apart from what decides the result.

    Attributes:
        stopwatch: Told the seconds per stage.
        folder: Where closed submaps, keyframes and the checkpoint are written, so that memory
            does not grow with the drive and a killed run can go on; it must stay as long as the
            result is used. None = all stays in memory.
        resume: Go on from the checkpoint in the folder, where there is one.
        threads: Threads of the matcher; None = all cores.
    """

    stopwatch: Stopwatch = field(default_factory=Stopwatch)
    folder: Path | None = None
    resume: bool = False
    threads: int | None = None

    @property
    def submaps(self) -> Path | None:
        """Folder of the submaps."""
        return None if self.folder is None else self.folder / "submaps"

    @property
    def loops(self) -> Path | None:
        """Folder of the keyframes."""
        return None if self.folder is None else self.folder / "loops"

    @property
    def rays(self) -> Path | None:
        """File of the rays of all frames."""
        return None if self.folder is None else self.folder / RAYS

    @property
    def frames(self) -> Path | None:
        """File of the poses and health of all frames."""
        return None if self.folder is None else self.folder / "frames.jsonl"

    @property
    def checkpoint(self) -> Checkpoint | None:
        """What the run goes on from."""
        return None if self.folder is None else Checkpoint(self.folder / "checkpoint.zip")
