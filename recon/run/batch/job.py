"""A job of a batch: one command in a process of its own, with a folder and a log of its own."""

from __future__ import annotations

import json
from collections.abc import Mapping
from contextlib import suppress
from dataclasses import asdict, dataclass, field, replace
from pathlib import Path
from typing import Any, Final, Literal

from pydantic import ConfigDict
from pydantic.dataclasses import dataclass as checked

from recon.io.files import reading
from recon.run.directory import RECORD, STARTED, state_folder
from recon.run.run import SUMMARY

State = Literal["not run", "succeeded", "failed", "broken"]
"""``failed``: by its input, so that another try would fail too. ``broken``: by anything else."""
LOGS: Final = "logs"
_TAIL_BYTES: Final = 1 << 16
"""At the end of a log, in which the last try is found."""


@dataclass(frozen=True)
class Job:
    """One command of a batch.

    Attributes:
        name: Its name, and that of its folder below that of the batch.
        command: The command, such as ``evaluate trajectory``.
        source: What it works on, for people.
        words: The command line after ``recon``, without the result folder.
        writes: Whether the command has an ``--out``; else what it prints is kept.
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

    def command_line(self, out: Path, *, resume: bool = False) -> list[str]:
        """Return the words after ``recon`` of a try, which may go on with what is in ``out``."""
        if not resume:
            return [*self.words, *(["--out", str(out)] if self.writes else [])]
        if self.command == "piece":
            return [*self.words, "--resume", str(out)]
        # A drive knows what it was begun with.
        kept = [
            word
            for name in ("--threads", "--memory-limit")
            if name in self.words
            for word in self.words[self.words.index(name) :][:2]
        ]
        return ["map", "--resume", str(out), *kept, "--json", "--verbose"]

    def resumes(self, out: Path) -> bool:
        """Return whether an earlier try left something to go on with."""
        return self.command in ("map", "piece") and (state_folder(out) / STARTED).is_file()


@checked(frozen=True, config=ConfigDict(allow_inf_nan=False, extra="forbid"))
class Outcome:
    """How the last try of a job ended, as its log has it.

    Attributes:
        state: How.
        error: Why it did not succeed, in one line.
        seconds: Its time.
        worker: Where it ran.
        tries: How often the job was begun.
        full: Whether a disk is full there.
        stale: Whether what it left is of no use: it went on with that, and failed.
    """

    state: State = "not run"
    error: str = ""
    seconds: float = 0.0
    worker: str = ""
    tries: int = 0
    full: bool = False
    stale: bool = False

    def line(self) -> bytes:
        """Return it as a line of a log."""
        text = json.dumps({"try": asdict(self)}, ensure_ascii=False)
        return text.encode(errors="replace") + b"\n"


def log_file(folder: Path, name: str) -> Path:
    """Return the log of a job: what its tries said, between an `Outcome` at each begin and end.

    A try is ``broken`` as long as it has not ended.
    """
    return folder / LOGS / f"{name}.log"


def last_outcome(folder: Path, name: str) -> Outcome:
    """Return how a job stands: by its folder whether it succeeded, all else by its log."""
    path, last = log_file(folder, name), Outcome("not run")
    if path.exists():
        with reading(path), path.open("rb") as file:
            file.seek(max(0, path.stat().st_size - _TAIL_BYTES))
            for line in file.read(_TAIL_BYTES).splitlines():
                if line.startswith(b'{"try": '):
                    with suppress(json.JSONDecodeError):  # cut off, such as on a full disk
                        last = Outcome(**json.loads(line)["try"])
    if is_done(folder / name):
        return replace(last, state="succeeded", error="")
    return replace(last, state="broken") if last.state == "succeeded" else last


def is_done(out: Path) -> bool:
    """Return whether the result of a job is there; the record is the last file of a run."""
    return (out / RECORD).is_file() and (out / SUMMARY).is_file()
