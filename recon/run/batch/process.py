"""One try of a job, on the machine of its worker."""

from __future__ import annotations

import contextlib
import json
import os
import platform
import shutil
import signal
import subprocess
import sys
import tempfile
import threading
import time
from collections import deque
from collections.abc import Callable, Mapping
from pathlib import Path
from typing import IO, Any, Final

from recon.core.errors import OutputError
from recon.io.lock import is_locked
from recon.run.batch.job import Job, Outcome, State, is_done
from recon.run.directory import lock_file
from recon.run.run import Run

Tell = Callable[[dict[str, Any]], None]
"""Told now and then how far a job is."""

_PROGRAM: Final = (sys.executable, "-m", "recon.run.batch.guard")
_LOOK_S: Final = 0.2
_OTHERS_S: Final = 90.0
_LEAST_FREE_BYTES: Final = 32_000_000
_INPUT: Final = (1, 2)
"""Exit codes of bad input and of wrong usage."""
_LONGEST: Final = 400


def run_job(
    job: Job,
    folder: Path,
    *,
    anew: bool = False,
    tell: Tell = lambda event: None,
    stopped: Callable[[], bool] = lambda: False,
    every_s: float = 1.0,
) -> Outcome:
    """Run the command of a job in a process of its own, into a folder of its own.

    The process ends with this one. A result that is there is not made again; what an earlier try
    of `recon map` has committed is gone on with.

    Args:
        job: The job.
        folder: Folder of the batch, seen by all workers.
        anew: Whether what an earlier try left is not used.
        tell: Told how far it is, at most every ``every_s`` seconds.
        stopped: Asked whether nobody waits for the job any more; its process is then killed.
        every_s: See ``tell``.
    """
    out, begun, where = folder / job.name, time.monotonic(), f"{platform.node()}:{os.getpid()}"
    if is_done(out):
        return Outcome("succeeded", worker=where)
    _wait_for_others(out, stopped)
    resumed = job.resumes(out) and not anew
    with tempfile.TemporaryFile() as printed:
        try:
            code, error = _run(job, out, anew, printed, _Teller(job.name, tell, every_s), stopped)
            if code == 0 and not job.writes:
                printed.seek(0)
                _keep(job, out, json.loads(printed.read()))
        except (OSError, OutputError, ValueError) as failure:
            code, error = -1, str(failure)
    full = code != 0 and any(
        shutil.disk_usage(place).free < _LEAST_FREE_BYTES
        for place in (out.parent, tempfile.gettempdir())
    )
    state = _state(job, out, code, full=full)
    seconds = round(time.monotonic() - begun, 3)
    return Outcome(state, "" if state == "succeeded" else error, seconds, where, resumed, full)


def _wait_for_others(out: Path, stopped: Callable[[], bool]) -> None:
    """Wait for an earlier try, whose worker does not know yet that its scheduler is gone."""
    late = time.monotonic() + _OTHERS_S
    while is_locked(lock_file(out)) and time.monotonic() < late and not stopped():
        time.sleep(_LOOK_S)


def _run(
    job: Job,
    out: Path,
    anew: bool,
    printed: IO[bytes],
    teller: _Teller,
    stopped: Callable[[], bool],
) -> tuple[int, str]:
    """Run the process to its end; returns its exit code and the line in which it says why."""
    command = [*_PROGRAM, *job.command_line(out, anew=anew)]
    process = subprocess.Popen(
        command,
        cwd=job.folder,
        stdin=subprocess.PIPE,
        stdout=printed,
        stderr=subprocess.PIPE,
        start_new_session=True,
        env=_environment(),
    )
    reader = threading.Thread(target=teller.read, args=(process.stderr,), daemon=True)
    reader.start()
    late = time.monotonic() + (job.timeout_s or float("inf"))
    why = ""
    try:
        while process.poll() is None and not why:
            if time.monotonic() > late:
                why = f"took more than {job.timeout_s:g} s"
            elif stopped():
                why = "was stopped"
            with contextlib.suppress(subprocess.TimeoutExpired):
                process.wait(_LOOK_S)
    finally:
        _kill(process)
    reader.join(timeout=10.0)
    code = process.returncode
    return (-1, why) if why else (code, teller.error() or _died(code))


def _environment() -> dict[str, str]:
    """Return the environment, in which the folder of the job cannot hide this program."""
    paths = (str(Path(__file__).parents[3]), os.environ.get("PYTHONPATH"))
    # The second is known to Python from 3.11 on: the working folder is not searched.
    return {
        **os.environ,
        "PYTHONPATH": os.pathsep.join(filter(None, paths)),
        "PYTHONSAFEPATH": "1",
    }


def _kill(process: subprocess.Popen[bytes]) -> None:
    """Kill what is left of a process and of those that it started."""
    with contextlib.suppress(ProcessLookupError):
        os.killpg(process.pid, signal.SIGKILL)
    process.wait()
    if process.stdin is not None:
        process.stdin.close()


def _died(code: int) -> str:
    if code >= 0:
        return f"ended with exit code {code}"
    memory = "; out of memory?" if -code == signal.SIGKILL else ""
    return f"its process was killed by signal {-code}{memory}"


def _state(job: Job, out: Path, code: int, *, full: bool) -> State:
    """Tell a job that failed by its input from one that broke."""
    if code == 0:
        return "succeeded" if is_done(out) else "broken"
    return "failed" if code in _INPUT and not job.resumes(out) and not full else "broken"


def _keep(job: Job, out: Path, summary: Mapping[str, Any]) -> None:
    """Write the folder of a command that writes none itself."""
    with Run(job.command, out) as run:
        run.finish(dict(summary), source=job.source, inputs=())


class _Teller:
    """Reads what a command says while it works: its progress, and in the end why it failed."""

    def __init__(self, name: str, tell: Tell, every_s: float) -> None:
        self._name, self._tell, self._every_s = name, tell, every_s
        self._last, self._total = 0.0, None
        self._lines: deque[str] = deque(maxlen=20)

    def read(self, stream: IO[bytes]) -> None:
        """Read all lines; JSON objects are events of the progress."""
        for line in stream:
            text = line.decode("utf-8", "replace").strip()
            try:
                event = json.loads(text) if text.startswith("{") else None
            except ValueError:
                event = None
            if event is None:
                self._lines.append(text)
            else:
                self._pass_on(event)

    def error(self) -> str:
        """Return the error in one line; "" = nothing was said."""
        lines = [line for line in self._lines if any(map(str.isalnum, line))]  # no frame of a box
        told = [line.removeprefix("error: ") for line in lines if line.startswith("error: ")]
        return (told or lines or [""])[-1][:_LONGEST]

    def _pass_on(self, event: Mapping[str, Any]) -> None:
        kind, now = event.get("event"), time.monotonic()
        if kind == "start":
            self._total = event.get("frames", event.get("scenes"))
        if kind == "stage" or (kind in ("frame", "scene") and now - self._last > self._every_s):
            self._last = now
            done = event["index"] + 1 if "index" in event else None
            told = {"frames": done, "of": self._total, "stage": event.get("name")}
            known = {key: value for key, value in told.items() if value is not None}
            self._tell({"event": "job", "name": self._name, "state": "running", **known})
