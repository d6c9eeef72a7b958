"""A try of a job ends in one of three ways, and never outlives its worker."""

import os
import signal
import subprocess
import sys
import threading
import time
from pathlib import Path

import pytest

from recon.core.errors import FormatError
from recon.io.atomic import take_lock
from recon.run.batch import job as process
from recon.run.batch.job import Job, Outcome, is_done, last_outcome, log_file, run_job
from recon.run.directory import lock_file
from tests.run.batch.jobs import job, tries
from tests.scenery.patience import LONG_S

PROGRAM = process._PROGRAM


def test_a_job_writes_its_folder_and_a_log_and_is_not_run_again(tmp_path):
    outcome = run_job(job("a"), tmp_path, "here")
    assert (outcome.state, outcome.error) == ("succeeded", "")
    assert (outcome.worker, outcome.tries, outcome.seconds > 0) == ("here", 1, True)
    assert is_done(tmp_path / "a")
    begun, command, started, frame, how_far, ended = log_of(tmp_path, "a")
    assert '"its worker died"' in begun
    assert command == f"recon map good --out {tmp_path / 'a'}"
    assert ("start" in started, "frame" in frame) == (True, True)
    assert '"succeeded"' in ended
    assert how_far == "progress: frames 1/2"
    assert run_job(job("a"), tmp_path, "there") == outcome
    assert tries(tmp_path, "a") == ["begun"]
    # But few of many frames.
    run_job(job("b", "says much"), tmp_path)
    log = log_of(tmp_path, "b")
    assert "warning: the lens is dirty" in log
    assert 1 <= sum('"frame"' in line for line in log) < 10


def test_what_is_left_of_a_log_counts(tmp_path):
    """Of a worker that died, which is as if the try had no end."""
    log_file(tmp_path, "a").parent.mkdir()
    tried = Outcome("broken", "its worker died", worker="w", tries=6)
    log_file(tmp_path, "a").write_bytes(b"x" * 200_000 + b"\n" + tried.line() + b'{"try": {"s')
    assert last_outcome(tmp_path, "a") == tried
    assert run_job(job("a"), tmp_path).tries == 7
    (tmp_path / "a" / "run.json").unlink()
    removed = last_outcome(tmp_path, "a")
    assert (removed.state, removed.error) == ("broken", "its result is gone")


def test_a_log_that_is_none_or_leads_elsewhere_is_one_line(tmp_path):
    log_file(tmp_path, "a").parent.mkdir()
    for line in ('{"try": 3}', '{"try": {"state": "x"}}', '{"try": {"seconds": NaN}}'):
        log_file(tmp_path, "a").write_text(line)
        with pytest.raises(FormatError, match=r"a\.log"):
            last_outcome(tmp_path, "a")
    log_file(tmp_path, "a").unlink()
    log_file(tmp_path, "a").symlink_to(tmp_path / "precious")
    with pytest.raises(FormatError, match="link"):
        run_job(job("a"), tmp_path)
    assert not (tmp_path / "precious").exists()


@pytest.mark.parametrize(
    ("what", "state", "error"),
    [
        ("bad", "failed", "nowhere: folder does not exist"),
        ("boxed", "failed", "No such option: --x"),
        ("killed once", "broken", "its process was killed by signal 9; out of memory?"),
    ],
)
def test_a_failure_by_the_input_has_the_line_of_the_command_and_a_death_its_signal(
    tmp_path, what, state, error
):
    outcome = run_job(job("a", what), tmp_path)
    assert (outcome.state, outcome.error, outcome.tries) == (state, error, 1)
    assert run_job(job("a", what), tmp_path).tries == 2


@pytest.mark.skipif(sys.version_info < (3, 11), reason="Python before 3.11 looks there first")
def test_what_is_in_the_folder_of_a_job_does_not_hide_the_program(tmp_path, monkeypatch):
    monkeypatch.setattr(process, "_PROGRAM", PROGRAM)
    (tmp_path / "recon").mkdir()
    for hidden in ("recon/__init__.py", "json.py"):
        (tmp_path / hidden).write_text("raise SystemExit('error: something else')")
    command = Job("a", "pair", "", ("pair", "left.png", "right.png"), True, str(tmp_path))
    assert run_job(command, tmp_path).error.startswith("left.png: file does not exist")


def test_what_can_be_resumed_is_broken_and_not_failed(tmp_path):
    outcome = run_job(job("a", "damaged"), tmp_path)
    assert (outcome.state, outcome.error, outcome.stale) == ("broken", "damaged", False)
    # What fails although it goes on with what was left begins anew.
    assert run_job(job("a", "damaged"), tmp_path).stale
    assert run_job(job("a", "damaged"), tmp_path).stale is False
    assert tries(tmp_path, "a") == ["begun", "resumed", "begun"]
    outcome = run_job(job("b", folder=str(tmp_path / "elsewhere")), tmp_path)
    assert (outcome.state, "elsewhere" in outcome.error) == ("broken", True)


def test_what_is_resumed_where_the_disk_is_full_goes_on_elsewhere(tmp_path, monkeypatch):
    monkeypatch.setattr(process, "_LEAST_FREE_BYTES", 1 << 62)
    for _ in range(2):
        outcome = run_job(job("a", "damaged"), tmp_path)
        assert (outcome.state, outcome.full, outcome.stale) == ("broken", True, False)
    assert run_job(job("b", "bad"), tmp_path).state == "broken"
    assert tries(tmp_path, "a") == ["begun", "resumed"]


@pytest.mark.parametrize(
    ("timeout_s", "error"), [(1.0, "took more than 1 s"), (None, "was stopped")]
)
def test_a_job_that_is_late_or_that_nobody_waits_for_is_killed(tmp_path, timeout_s, error):
    begun = tmp_path / "a.pid"
    nobody = begun.is_file if timeout_s is None else lambda: False
    outcome = run_job(job("a", "endless", timeout_s=timeout_s), tmp_path, stopped=nobody)
    assert (outcome.state, outcome.error) == ("broken", error)
    assert ended(int(begun.read_text()))


def test_a_try_waits_for_an_earlier_one_that_still_runs(tmp_path):
    lock = take_lock(lock_file(tmp_path / "a"), "", where=tmp_path, hint="")
    left_off = []

    def leave_off() -> None:
        left_off.append(not (tmp_path / "a" / "summary.json").exists())
        os.close(lock)

    release = threading.Timer(1.0, leave_off)
    release.start()
    assert run_job(job("a"), tmp_path).state == "succeeded"
    assert left_off == [True]
    release.join()


def test_a_command_without_a_result_folder_gets_one(tmp_path, monkeypatch):
    monkeypatch.setattr(process, "_PROGRAM", PROGRAM)
    words = ("datasets", "list", "euroc", "--json")
    outcome = run_job(Job("a", "datasets list", "euroc", words, writes=False, folder="."), tmp_path)
    assert outcome.state == "succeeded", outcome.error
    assert '"name": "euroc"' in (tmp_path / "a" / "summary.json").read_text()


def test_the_process_of_a_job_dies_with_its_worker(tmp_path):
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
    pids = [int(worker.stdout.readline()) for _ in range(2)]
    os.kill(worker.pid, signal.SIGKILL)
    worker.wait()
    worker.stdout.close()
    assert all(ended(pid) for pid in pids)


def log_of(folder: Path, name: str) -> list[str]:
    return log_file(folder, name).read_text().splitlines()


def ended(pid: int, within_s: float = LONG_S) -> bool:
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
