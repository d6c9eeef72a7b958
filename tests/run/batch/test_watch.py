"""A batch is watched by what its folder says."""

import json
import os
import shutil
import threading

import pytest
from typer.testing import CliRunner

from recon.cli import app
from recon.core.errors import FormatError
from recon.io.atomic import take_lock
from recon.run.batch.job import Outcome, log_file
from recon.run.batch.job_file import JobList
from recon.run.batch.results import JobResult, watch_jobs, wrong_first
from recon.run.directory import lock_file
from tests.run.batch.jobs import job

BEGUN = Outcome("broken", "its worker died", tries=1)


@pytest.fixture
def folder(tmp_path):
    jobs = [{"name": name, "command": "demo"} for name in "abc"]
    JobList.model_validate({"job": jobs, "folder": str(tmp_path)}).write(tmp_path)
    lock_file(tmp_path).parent.mkdir()
    return tmp_path


@pytest.fixture
def lock(folder):
    handle = take_lock(lock_file(folder), "locked", where=folder, hint="")
    yield handle
    os.close(handle)


def say(folder, name, *outcomes, **summary):
    log_file(folder, name).parent.mkdir(exist_ok=True)
    with log_file(folder, name).open("ab") as log:
        log.writelines(one.line() for one in outcomes)
    if summary:
        (folder / name).mkdir(exist_ok=True)
        (folder / name / "summary.json").write_text(json.dumps(summary))
        (folder / name / "run.json").write_text("{}")


def states(results):
    return {one.job.name: one.facts.state for one in results}


def test_a_job_is_seen_to_run_and_to_end_with_its_figures_and_size(folder, lock):
    rounds = watch_jobs(folder, [job(name) for name in "abc"], every_s=0.0)
    say(folder, "a", BEGUN)
    assert states(next(rounds)) == {"a": "running", "b": "not run", "c": "not run"}
    say(folder, "a", Outcome("succeeded", seconds=2.0, tries=1), points=7, warnings=[])
    say(folder, "b", BEGUN, Outcome("failed", "no images", 1.0, tries=1))
    first, second, _ = next(rounds)
    assert (first.figures, first.seconds, first.bytes) == ({"points": 7, "warnings": 0}, 2.0, 31)
    assert (second.failed, second.last.error) == (True, "no images")
    say(folder, "c", BEGUN)
    assert states(next(rounds))["c"] == "running"


def test_when_nobody_runs_it_the_last_look_says_what_was_cut_off(folder):
    say(folder, "a", BEGUN)
    (found,) = watch_jobs(folder, [job("a")])
    assert states(found) == {"a": "failed"}
    assert found[0].last.error == "its worker died"


@pytest.mark.parametrize("text", ["", "{", "[]", '{"warnings": 5}', "\0"])
def test_what_is_half_written_is_not_there_yet(folder, text):
    say(folder, "a", BEGUN, seconds=1)
    (folder / "a" / "summary.json").write_text(text)
    log_file(folder, "b").write_bytes(b'{"try": {"state": "succ')
    log_file(folder, "c").write_bytes(b'{"try": {"state": "odd"}}\n')
    (found,) = watch_jobs(folder, [job(name) for name in "abc"])
    assert states(found) == {"a": "succeeded", "b": "not run", "c": "not run"}
    assert found[0].figures == {}


@pytest.mark.usefixtures("lock")
def test_a_folder_that_is_removed_meanwhile_ends_it_in_one_line(folder):
    rounds = watch_jobs(folder, [job("a")], every_s=0.0)
    next(rounds)
    shutil.rmtree(folder)
    with pytest.raises(FormatError, match="folder of the batch was removed"):
        next(rounds)


def watched(folder):
    return CliRunner().invoke(app, ["batch", "--watch", str(folder)])


def test_where_there_is_no_terminal_each_change_is_a_line(folder):
    handle = take_lock(lock_file(folder), "locked", where=folder, hint="")
    say(folder, "a", BEGUN)

    def end():
        say(folder, "a", Outcome("failed", "no images", 3.0, tries=1))
        say(folder, "b", Outcome("succeeded", seconds=2.0, tries=2), points=7)
        os.close(handle)

    timer = threading.Timer(0.5, end)
    timer.start()
    done = watched(folder)
    timer.join()
    assert done.exit_code == 0
    lines = done.stdout.splitlines()
    assert sorted(lines[-2:]) == [
        "a: failed, try 1, 3.0 s: no images",
        "b: succeeded, try 2, 2.0 s",
    ]
    assert set(lines[:-2]) <= {"a: running, try 1, 0.0 s"}
    hint = f"recon batch --resume {folder} does what is missing"
    assert done.stderr == f"warning: no process runs this batch; {hint}\n"


def test_a_folder_without_a_batch_is_one_line(tmp_path):
    for path in (tmp_path, tmp_path / "nowhere"):
        done = watched(path)
        assert (done.exit_code, done.stdout) == (1, "")
        assert "folder holds no batch" in done.stderr
        assert done.stderr.count("\n") == 1
    done = CliRunner().invoke(app, ["batch", "demo", "--watch", str(tmp_path)])
    assert done.exit_code == 2


def test_failures_come_first_then_trust_then_drift():
    done = Outcome("succeeded", seconds=1.0, tries=1)
    figures = {
        "fine": {"t_rel_percent": 0.5, "frames": 100},
        "drifting": {"t_rel_percent": 5.0, "frames": 100},
        "untrusted": {"t_rel_percent": 0.5, "frames": 100, "frames_not_trusted": 30},
        "long": {"t_rel_percent": 0.4, "frames": 9000, "frames_not_trusted": 40},
    }
    results = [JobResult(job(name), done, found) for name, found in figures.items()]
    results.append(JobResult(job("failed"), Outcome("failed", "why")))
    order = ["failed", "untrusted", "long", "drifting", "fine"]
    assert [one.job.name for one in wrong_first(results)] == order
