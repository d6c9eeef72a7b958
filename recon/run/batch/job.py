"""A job of a batch: one command in a process of its own, with a folder of its own."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import asdict, dataclass, field
from pathlib import Path
from typing import Any, Final, Literal

from recon.run.directory import RECORD, STARTED, state_folder
from recon.run.run import SUMMARY

State = Literal["succeeded", "failed", "broken"]
"""``failed``: by its input, so that another try would fail too. ``broken``: by anything else."""
_DRIVE: Final = "map"
_PIECE: Final = "piece"


@dataclass(frozen=True)
class Job:
    """One command of a batch; plain values, so that it travels and is kept as JSON.

    Attributes:
        name: Its name, and that of its folder below that of the batch.
        command: The command, such as ``evaluate trajectory``.
        source: What it works on, for people.
        words: The command line after ``recon``, without result folder and output options.
        writes: Whether the command has an ``--out``; else its ``--json`` is kept.
        folder: Where relative paths of the command line begin.
        timeout_s: Longest time of one try; None = any.
        retries: How often it is tried again when its worker died, or it was killed or late.
        needs: What it takes of a worker that declares such resources (``threads``, ``memory``).
        swept: The settings that a sweep gave it.
    """

    name: str
    command: str
    source: str
    words: tuple[str, ...]
    writes: bool
    folder: str
    timeout_s: float | None = None
    retries: int = 2
    needs: Mapping[str, float] = field(default_factory=dict)
    swept: Mapping[str, Any] = field(default_factory=dict)

    def plain(self) -> dict[str, Any]:
        """Return it as JSON holds it."""
        return asdict(self)

    def command_line(self, out: Path, *, anew: bool = False) -> list[str]:
        """Return the words after ``recon`` of the next try: the rest of an earlier one, or all.

        Args:
            out: Its result folder.
            anew: Whether what an earlier try left is not used.
        """
        shown = ["--json", "--verbose"] if self.writes else ["--json"]
        if not self.writes:
            return [*self.words, *shown]
        if self.resumes(out) and not anew:
            # A drive knows what it was begun with; a piece of one is told again.
            if self.command == _PIECE:
                return [*self.words, "--resume", str(out), *shown]
            kept = [*_option(self.words, "--threads"), *_option(self.words, "--memory-limit")]
            return [_DRIVE, "--resume", str(out), *kept, *shown]
        return [*self.words, "--out", str(out), *shown]

    def resumes(self, out: Path) -> bool:
        """Return whether an earlier try left something to go on with."""
        return self.command in (_DRIVE, _PIECE) and (state_folder(out) / STARTED).is_file()


@dataclass(frozen=True)
class Outcome:
    """How one try of a job ended.

    Attributes:
        state: How.
        error: Why it did not succeed, in one line.
        seconds: Its time.
        worker: Where it ran.
        resumed: Whether it went on with what an earlier try had left.
        full: Whether a disk is full there.
    """

    state: State
    error: str = ""
    seconds: float = 0.0
    worker: str = ""
    resumed: bool = False
    full: bool = False


def is_done(out: Path) -> bool:
    """Return whether the result of a job is there; the record is the last file of a run."""
    return (out / RECORD).is_file() and (out / SUMMARY).is_file()


def _option(words: tuple[str, ...], name: str) -> list[str]:
    """Return an option with its value, if it is there."""
    return list(words[words.index(name) : words.index(name) + 2]) if name in words else []
