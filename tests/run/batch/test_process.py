"""A try of a job ends in one of three ways, and never outlives its worker."""

from __future__ import annotations

import os
import signal
import subprocess
import sys
import threading
import time
from pathlib import Path
from typing import Any

import pytest

import recon
from recon.io.lock import take_lock
from recon.run.batch import process
from recon.run.batch.job import Job, is_done
from recon.run.batch.process import run_job
from recon.run.directory import lock_file
from tests.run.batch.jobs import job, stand_in, tries

__all__ = ["stand_in"]
usefixtures = pytest.mark.usefixtures("stand_in")


@usefixtures
def test_a_job_writes_its_folder_and_tells_how_far_it_is(tmp_path: Path) -> None:
    told: list[dict[str, Any]] = []
    outcome = run_job(job("a"), tmp_path, tell=told.append, every_s=0.0)
    assert (outcome.state, outcome.error, outcome.resumed) == ("succeeded", "", False)
    assert is_done(tmp_path / "a")
    assert told == [{"event": "job", "name": "a", "state": "running", "frames": 2, "of": 2}]


@usefixtures
def test_a_result_that_is_there_is_not_made_again(tmp_path: Path) -> None:
    for _ in range(2):
        assert run_job(job("a"), tmp_path).state == "succeeded"
    assert tries(tmp_path, "a") == ["begun"]


@usefixtures
def test_bad_input_is_a_failure_with_the_line_of_the_command(tmp_path: Path) -> None:
    outcome = run_job(job("a", "bad"), tmp_path)
    assert (outcome.state, outcome.error) == ("failed", "nowhere: folder does not exist")


@usefixtures
def test_a_killed_job_is_broken_and_goes_on_where_it_was(tmp_path: Path) -> None:
    killed = run_job(job("a", "killed once"), tmp_path)
    assert killed.state == "broken"
    assert killed.error == "its process was killed by signal 9; out of memory?"
    again = run_job(job("a", "killed once"), tmp_path)
    assert (again.state, again.resumed) == ("succeeded", True)
    assert tries(tmp_path, "a") == ["begun", "resumed"]


def test_a_job_runs_the_program_of_its_worker(tmp_path: Path) -> None:
    found = subprocess.run(
        [sys.executable, "-c", "import recon; print(recon.__file__)"],
        cwd=tmp_path, env=process._environment(), capture_output=True, text=True, check=True,
    )  # fmt: skip
    assert Path(found.stdout.strip()).samefile(recon.__file__)


@pytest.mark.skipif(sys.version_info < (3, 11), reason="Python before 3.11 looks there first")
def test_what_is_in_the_folder_of_a_job_does_not_hide_the_program(tmp_path: Path) -> None:
    (tmp_path / "recon").mkdir()
    for hidden in ("recon/__init__.py", "json.py"):
        (tmp_path / hidden).write_text("raise SystemExit('error: something else')")
    command = Job("a", "pair", "", ("pair", "left.png", "right.png"), True, str(tmp_path))
    assert run_job(command, tmp_path).error.startswith("left.png: file does not exist")


@usefixtures
def test_a_job_can_begin_anew(tmp_path: Path) -> None:
    run_job(job("a", "killed once"), tmp_path)
    assert run_job(job("a", "killed once"), tmp_path, anew=True).state == "broken"
    assert tries(tmp_path, "a") == ["begun", "begun"]


@usefixtures
def test_what_can_be_resumed_is_broken_and_not_failed(tmp_path: Path) -> None:
    outcome = run_job(job("a", "full"), tmp_path)
    assert (outcome.state, outcome.error) == ("broken", "the disk is full")


@usefixtures
def test_a_late_job_is_killed(tmp_path: Path) -> None:
    outcome = run_job(job("a", "endless", timeout_s=1.0), tmp_path)
    assert (outcome.state, outcome.error) == ("broken", "took more than 1 s")
    assert ended(int((tmp_path / "a.pid").read_text()))


@usefixtures
def test_a_job_that_nobody_waits_for_is_killed(tmp_path: Path) -> None:
    begun = tmp_path / "a.pid"
    outcome = run_job(job("a", "endless"), tmp_path, stopped=begun.is_file)
    assert (outcome.state, outcome.error) == ("broken", "was stopped")
    assert ended(int(begun.read_text()))


@usefixtures
def test_a_try_waits_for_an_earlier_one_that_still_runs(tmp_path: Path) -> None:
    lock = take_lock(lock_file(tmp_path / "a"), "", where=tmp_path, hint="")
    release = threading.Timer(1.0, os.close, [lock])
    release.start()
    begun = time.monotonic()
    assert run_job(job("a"), tmp_path).state == "succeeded"
    assert time.monotonic() - begun >= 1.0
    release.join()


@usefixtures
def test_a_folder_that_this_worker_does_not_see_is_one_line(tmp_path: Path) -> None:
    outcome = run_job(job("a", folder=str(tmp_path / "elsewhere")), tmp_path)
    assert outcome.state == "broken"
    assert "elsewhere" in outcome.error


def test_a_command_without_a_result_folder_gets_one(tmp_path: Path) -> None:
    """With the real program."""
    words = ("datasets", "list", "euroc")
    outcome = run_job(Job("a", "datasets list", "euroc", words, writes=False, folder="."), tmp_path)
    assert outcome.state == "succeeded", outcome.error
    assert '"name": "euroc"' in (tmp_path / "a" / "summary.json").read_text()


def test_the_process_of_a_job_dies_with_its_worker(tmp_path: Path) -> None:
    """Even where the worker is killed at once, and the job has processes of its own."""
    (tmp_path / "recon").mkdir()
    (tmp_path / "recon" / "__init__.py").write_text("")
    (tmp_path / "recon" / "__main__.py").write_text(
        "import subprocess, sys, time\n"
        "child = subprocess.Popen([sys.executable, '-c', 'import time; time.sleep(600)'])\n"
        "print(child.pid, flush=True)\n"
        "time.sleep(600)\n"
    )
    guard = Path(__file__).parents[3] / "recon" / "run" / "batch" / "guard.py"
    start = (
        "import subprocess, sys\n"
        "job = subprocess.Popen(sys.argv[1:], stdin=subprocess.PIPE, start_new_session=True)\n"
        "print(job.pid, flush=True)\n"
        "job.wait()\n"
    )
    worker = subprocess.Popen(
        [sys.executable, "-c", start, sys.executable, str(guard), "map"],
        stdout=subprocess.PIPE,
        env={**os.environ, "PYTHONPATH": str(tmp_path)},
    )
    assert worker.stdout is not None
    pids = [int(worker.stdout.readline()) for _ in range(2)]
    os.kill(worker.pid, signal.SIGKILL)
    worker.wait()
    worker.stdout.close()
    assert all(ended(pid) for pid in pids)


def ended(pid: int, within_s: float = 30.0) -> bool:
    """Whether a process is gone or a zombie, now or soon."""
    late = time.monotonic() + within_s
    while time.monotonic() < late:
        try:
            state = Path(f"/proc/{pid}/stat").read_text().rpartition(")")[2].split()[0]
        except OSError:
            return True
        if state == "Z":
            return True
        time.sleep(0.05)
    return False
