"""A job of a batch: one command in a process of its own, with a folder and a log of its own."""

from __future__ import annotations

import json
import math
import os
import platform
import re
import shlex
import shutil
import signal
import subprocess
import sys
import tempfile
import threading
import time
from collections.abc import Callable, Mapping
from contextlib import suppress
from dataclasses import asdict, dataclass, field, fields, replace
from pathlib import Path
from typing import IO, Any, Final, Literal

from pydantic import ConfigDict
from pydantic.dataclasses import dataclass as checked
from typing_extensions import Self

from recon.core.errors import OutputError
from recon.core.summary import RunSummary, inline
from recon.io.atomic import is_locked
from recon.io.files import reading, refuse_links
from recon.run.directory import RECORD, STARTED, lock_file, state_folder
from recon.run.run import SUMMARY, Run

State = Literal["not run", "running", "succeeded", "failed", "broken"]
"""``running``: seen from outside, in no log. ``failed``: by its input, so that another try would
fail too. ``broken``: by anything else."""
LOGS: Final = "logs"
_TAIL_BYTES: Final = 1 << 16  # at the end of a log, in which the last try is found
_PROGRAM: Final = (sys.executable, "-m", "recon.run.batch.guard")
_LOOK_S: Final = 0.2
_OTHERS_S: Final = 90.0
_STARTED: Final = re.compile(rb'\{"event": "start".*"(\w+)": (\d+)\}')
_PROGRESS: Final = b"progress: "
LOG_S: Final = 10.0  # the log of a job has so many seconds between two of its frames
_LEAST_FREE_BYTES: Final = 32_000_000
_INPUT: Final = (1, 2)  # exit codes of bad input and of wrong usage
_LONGEST: Final = 400


@dataclass(frozen=True)
class Job:
    """One command of a batch, such as ``evaluate trajectory``, with a folder by its name."""

    name: str
    command: str
    source: str
    words: tuple[str, ...]  # the command line after ``recon``, without the result folder
    writes: bool  # whether the command has an ``--out``; else what it prints is kept
    folder: str  # where relative paths of the command line begin
    timeout_s: float | None = None  # longest time of one try; None = any
    retries: int = 2
    # What it takes of a worker that declares such resources (``threads``, ``memory``)
    needs: Mapping[str, float] = field(default_factory=dict)
    swept: Mapping[str, Any] = field(default_factory=dict)  # the settings that a sweep gave it

    def command_line(self, out: Path, *, resume: bool = False) -> list[str]:
        """Return the words after ``recon`` of a try, which may go on with what is in ``out``."""
        if not resume:
            return [*self.words, *(["--out", str(out)] if self.writes else [])]
        if self.command == "piece":
            return [*self.words, "--resume", str(out)]
        limits = ("--threads", "--memory-limit")  # all else a drive knows that was begun
        at = [self.words.index(name) for name in limits if name in self.words]
        kept = [word for place in at for word in self.words[place : place + 2]]
        return ["map", "--resume", str(out), *kept, "--json", "--verbose"]

    def resumes(self, out: Path) -> bool:
        """Return whether an earlier try left something to go on with."""
        return self.command in ("map", "piece") and (state_folder(out) / STARTED).is_file()


@checked(frozen=True, config=ConfigDict(allow_inf_nan=False, extra="forbid"))
class Outcome:
    """How the last try of a job ended, as its log has it."""

    state: State = "not run"
    error: str = ""
    seconds: float = 0.0
    worker: str = ""
    tries: int = 0  # how often the job was begun
    full: bool = False  # whether a disk is full where it ran
    stale: bool = False  # whether what it left is of no use: it went on with that, and failed

    def line(self) -> bytes:
        text = json.dumps({"try": asdict(self)}, ensure_ascii=False)
        return text.encode(errors="replace") + b"\n"


def log_file(folder: Path, name: str) -> Path:
    """Return the log of a job: what its tries said, between an `Outcome` at each begin and end."""
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
    gone = last.state == "succeeded"
    return replace(last, state="broken", error="its result is gone") if gone else last


def progress_of(folder: Path, name: str) -> str:
    """Return what a job does that runs, by the end of its log: ``map, frames 120/400, 7.9/s``."""
    stage = done = ""
    with suppress(OSError), log_file(folder, name).open("rb") as file:
        file.seek(-min(_TAIL_BYTES, os.fstat(file.fileno()).st_size), os.SEEK_END)
        for line in file:
            if line.startswith((b'{"try": ', b'{"event": "stage"')):
                with suppress(json.JSONDecodeError):
                    stage, done = json.loads(line).get("name", ""), ""
            elif line.startswith((b'{"event": "start"', b'{"event": "finish"')):
                done = ""
            elif line.startswith(_PROGRESS):
                done = line[len(_PROGRESS) :].decode(errors="replace").strip()
    return ", ".join(filter(None, (stage, done)))


def is_done(out: Path) -> bool:
    """Return whether the result of a job is there; the record is the last file of a run."""
    return (out / RECORD).is_file() and (out / SUMMARY).is_file()


def run_job(
    job: Job, folder: Path, worker: str = "", stopped: Callable[[], bool] = lambda: False
) -> Outcome:
    """Run the command of a job in a process of its own, which ends with this one.

    A result that is there is not made again; what an earlier try of `recon map` has committed is
    gone on with, unless that has failed already. The process is killed when it is ``stopped``:
    nobody waits for the job any more.
    """
    out, last = folder / job.name, last_outcome(folder, job.name)
    if last.state == "succeeded":
        return last
    # An earlier try, whose worker does not know yet that its scheduler is gone.
    until = time.monotonic() + _OTHERS_S
    while is_locked(lock_file(out)) and time.monotonic() < until and not stopped():
        time.sleep(_LOOK_S)
    path, begun = log_file(folder, job.name), time.monotonic()
    path.parent.mkdir(exist_ok=True)
    refuse_links(path.parent)
    resume = job.resumes(out) and not last.stale
    line = job.command_line(out, resume=resume)
    where = worker or f"{platform.node()}:{os.getpid()}"
    tried = Outcome("broken", "its worker died", worker=where, tries=last.tries + 1)
    with path.open("ab", buffering=0) as log:
        log.write(tried.line() + f"{shlex.join(['recon', *line])}\n".encode(errors="replace"))
        code, error = _run(job, line, out, log, stopped)
        free = (shutil.disk_usage(place).free for place in (folder, tempfile.gettempdir()))
        full = code != 0 and min(free) < _LEAST_FREE_BYTES
        done = code == 0 and is_done(out)
        by_input = code in _INPUT and not job.resumes(out) and not full
        ended = replace(
            tried,
            state="succeeded" if done else "failed" if by_input else "broken",
            error="" if done else error,
            seconds=round(time.monotonic() - begun, 3),
            full=full,
            stale=resume and code > 0 and not full,
        )
        with suppress(OSError):  # a full disk, of which the outcome tells
            log.write(ended.line())
    return ended


@dataclass(frozen=True, kw_only=True)
class PrintedSummary(RunSummary):
    """What a command printed that has no result folder."""

    printed: Mapping[str, Any] = inline()

    @classmethod
    def of(cls, printed: Mapping[str, Any]) -> Self:
        """Return what was printed; the cost is that of the job."""
        own = {one.name for one in fields(RunSummary)}
        rest = {key: value for key, value in printed.items() if key not in own}
        return cls(printed=rest, warnings=printed.get("warnings", ()))


def _run(
    job: Job, line: list[str], out: Path, log: IO[bytes], stopped: Callable[[], bool]
) -> tuple[int, str]:
    """Run the process to its end; returns its exit code and the line in which it says why."""
    said = [""]
    # The folder of the job cannot hide this program: from Python 3.11 on, the second keeps it from
    # searching the working folder.
    paths = filter(None, (str(Path(__file__).parents[3]), os.environ.get("PYTHONPATH")))
    environment = {"PYTHONPATH": os.pathsep.join(paths), "PYTHONSAFEPATH": "1"}
    try:
        with tempfile.TemporaryFile() as printed:
            process = subprocess.Popen(
                [*_PROGRAM, *line],
                cwd=job.folder,
                stdin=subprocess.PIPE,
                stdout=printed,
                stderr=subprocess.PIPE,
                start_new_session=True,
                env={**os.environ, **environment},
            )
            listener = threading.Thread(
                target=_listen, args=(process.stderr, log, said), daemon=True
            )
            listener.start()
            why = _wait(process, job.timeout_s or math.inf, stopped)
            listener.join(timeout=10.0)
            if process.returncode == 0 and not job.writes:
                printed.seek(0)
                with Run(job.command, out) as run:
                    run.finish(
                        PrintedSummary.of(json.loads(printed.read())), source=job.source, inputs=()
                    )
    except (OSError, OutputError, ValueError) as failure:
        return -1, str(failure)
    code, error = process.returncode, said[0].removeprefix("error: ")[:_LONGEST]
    if not error and code < 0:
        memory = "; out of memory?" if -code == signal.SIGKILL else ""
        error = f"its process was killed by signal {-code}{memory}"
    return (-1, why) if why else (code, error or f"ended with exit code {code}")


def _listen(stream: IO[bytes], log: IO[bytes], said: list[str]) -> None:
    """Keep what a process says in its log; ``said`` gets the line in which it says why it ended."""
    shown_s, begun_s, done, total, unit = -math.inf, 0.0, 0, b"?", b"frames"
    for line in stream:
        how_far = b""
        if started := _STARTED.match(line):
            begun_s, done, unit, total = time.monotonic(), 0, *started.groups()
        elif line.startswith((b'{"event": "frame"', b'{"event": "scene"')):
            done, now_s = done + 1, time.monotonic()
            if now_s < shown_s + LOG_S:
                continue
            shown_s = now_s
            rate = b", %.1f/s" % (done / (now_s - begun_s)) if done > 1 else b""
            how_far = _PROGRESS + b"%b %d/%b%b\n" % (unit, done, total, rate)
        with suppress(OSError, ValueError):  # a full disk; a log that was closed
            log.write(line + how_far)
        text = line.decode("utf-8", "replace").strip().strip("│ ")  # a box around it
        is_plain = any(map(str.isalnum, text)) and not text.startswith("{")
        if text.startswith("error: ") or (is_plain and not said[0].startswith("error: ")):
            said[0] = text


def _wait(process: subprocess.Popen[bytes], timeout_s: float, stopped: Callable[[], bool]) -> str:
    """Wait for the end of a process, or end it with all it started; returns why, or ""."""
    late, why = time.monotonic() + timeout_s, ""
    try:
        while process.poll() is None and not why:
            if time.monotonic() > late:
                why = f"took more than {timeout_s:g} s"
            elif stopped():
                why = "was stopped"
            with suppress(subprocess.TimeoutExpired):
                process.wait(_LOOK_S)
    finally:
        with suppress(ProcessLookupError):
            os.killpg(process.pid, signal.SIGKILL)
        process.wait()
        if process.stdin is not None:
            process.stdin.close()
    return why
