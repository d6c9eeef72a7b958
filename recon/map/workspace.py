"""The workspace of a run: its state on disk, threads and stopwatch."""

from __future__ import annotations

from dataclasses import dataclass, field
from pathlib import Path
from typing import Final

from recon.map.checkpoint import Checkpoint
from recon.run.stopwatch import Stopwatch

RAYS: Final = "rays.bin"


@dataclass(frozen=True)
class Workspace:
    """Resources of a run, none of which affect the result.

    Attributes:
        stopwatch: Times each stage.
        folder: Folder for closed submaps, keyframes and the checkpoint, so that memory does not
            grow with the drive and an interrupted run can be resumed; it must exist as long as the
            result is used. None = everything stays in memory.
        resume: Resume from the checkpoint in the folder, if there is one.
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
        """The checkpoint that the run resumes from."""
        return None if self.folder is None else Checkpoint(self.folder / "checkpoint.zip")
