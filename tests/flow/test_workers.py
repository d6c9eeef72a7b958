"""What workers do ends as if nothing had happened, whatever dies on the way."""

import json
import shlex
import signal
import subprocess
import sys
import time
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from recon.map.map import Map
from tests.flow.runs import RECON, STATE, begun, content
from tests.hostile.refusals import assert_refused, run
from tests.scenery.kitti import street_drive
from tests.scenery.middlebury import write_scene
from tests.scenery.patience import LONG_S

psutil = pytest.importorskip("psutil")
distributed = pytest.importorskip("distributed")

Client = subprocess.Popen[bytes]
QUIET = {"stdout": subprocess.DEVNULL, "stderr": subprocess.DEVNULL}
ASKED = {"stdout": subprocess.DEVNULL, "stderr": subprocess.PIPE}
JOB = "recon.run.batch.guard"
DRIVES, KILLS = 3, 10


def slow(test: Callable[..., None]) -> Callable[..., None]:
    return pytest.mark.slow(pytest.mark.timeout(1800)(test))


def below(client: Client, *words: str) -> list[psutil.Process]:
    found = []
    for process in psutil.Process(client.pid).children(recursive=True):
        try:
            line = " ".join(process.cmdline())
        except psutil.Error:
            continue
        if any(word in line for word in words):
            found.append(process)
    return found


def wait_until(fact: Callable[[], object], client: Client, what: str) -> None:
    late = time.monotonic() + LONG_S
    while not fact():
        assert client.poll() is None, f"the client ended before {what}"
        assert time.monotonic() < late, f"no {what}"
        time.sleep(0.1)


def assert_gone(processes: list[psutil.Process]) -> None:
    assert psutil.wait_procs(processes, timeout=LONG_S)[1] == []


def ended(*words: object, code: int = 0) -> dict[str, Any]:
    done = subprocess.run([*RECON, *map(str, words), "--json"], capture_output=True, check=False)
    assert done.returncode == code, done.stderr
    return dict(json.loads(done.stdout))


def counts(summary: dict[str, Any]) -> list[int]:
    return [summary[state] for state in ("succeeded", "failed", "not_run")]


def content_of_jobs(out: Path) -> dict[str, bytes]:
    folders = sorted(path.parent for path in out.glob("*/run.json"))
    return {f"{job.name}/{name}": data for job in folders for name, data in content(job).items()}


class Batches:
    def __init__(self, folder: Path) -> None:
        self.folder, self.jobs = folder, folder / "jobs.toml"
        settings = ["checkpoints.every_frames=5", "submaps.length_m=4", "submaps.tile_m=12.8"]
        self.jobs.write_text(
            '[[job]]\nname = "pair"\ncommand = "pair"\nsource = "scene"\n'
            + "".join(
                f'[[job]]\nname = "drive{n}"\ncommand = "map"\nsource = "drive{n}"\n'
                f'options = ["--no-mesh"]\nset = {settings}\n'
                for n in range(DRIVES)
            )
        )
        for n in range(DRIVES):
            street_drive(folder / f"drive{n}", 24, seed=n)
        write_scene(folder / "scene")
        self.all = [DRIVES + 1, 0, 0]
        assert counts(ended(*self.words(folder / "unbroken"))) == self.all

    def words(self, out: Path) -> list[object]:
        options = ["--workers", "2", "--threads", "1", "--retries", "30"]
        return ["batch", self.jobs, "--out", out, *options]

    def begin(self, out: Path, program: Sequence[str] = RECON, **streams: int) -> Client:
        client = subprocess.Popen([*program, *map(str, self.words(out)), "--json"], **streams)
        wait_until(lambda: below(client, JOB), client, "first job")
        return client

    def finish(self, out: Path) -> None:
        """Resume until everything is there, and compare with the undisturbed batch."""
        assert counts(ended("batch", "--resume", out, "--workers", "2")) == self.all
        assert content_of_jobs(out) == content_of_jobs(self.folder / "unbroken")


@pytest.fixture(scope="module")
def batches(tmp_path_factory):
    return Batches(tmp_path_factory.mktemp("batches"))


@slow
def test_workers_and_jobs_killed_at_random_change_nothing(batches, tmp_path):
    rng, kills, out = np.random.default_rng(0), 0, tmp_path / "out"
    client = batches.begin(out, stdout=subprocess.PIPE, stderr=subprocess.PIPE)
    while client.poll() is None and kills < KILLS:
        time.sleep(rng.uniform(0.5, 8.0))
        if client.poll() is None and (found := below(client, JOB, "multiprocessing.spawn")):
            victim = found[rng.integers(len(found))]
            if victim.is_running():
                victim.send_signal(signal.SIGKILL)
                kills += 1
    printed, told = client.communicate()
    assert client.returncode == 0, told
    assert kills >= KILLS // 2, "too few processes were killed before the batch was done"
    assert sum(job["tries"] for job in json.loads(printed)["jobs"]) > DRIVES + 1
    batches.finish(out)


@slow
def test_a_killed_client_leaves_no_process_and_can_resume(batches, tmp_path):
    out = tmp_path / "out"
    client = batches.begin(out, **QUIET)
    # One drive is done, another is being mapped.
    wait_until(lambda: list(out.glob("drive?/run.json")), client, "first result")
    wait_until(lambda: below(client, JOB), client, "second job")
    done = {path: path.stat().st_mtime_ns for path in out.glob("*/run.json")}
    left = below(client, "recon", "spawn")
    client.kill()
    client.wait()
    assert_gone(left)
    assert not (out / "summary.json").exists()
    batches.finish(out)
    assert {path: path.stat().st_mtime_ns for path in done} == done


@slow
def test_an_interrupted_batch_says_how_to_go_on(batches, tmp_path):
    out = tmp_path / "out"
    # Whoever runs the tests in the background has them ignore SIGINT.
    start = (
        "import runpy, signal\n"
        "signal.signal(signal.SIGINT, signal.default_int_handler)\n"
        "runpy.run_module('recon', run_name='__main__', alter_sys=True)\n"
    )
    client = batches.begin(out, [sys.executable, "-c", start], **ASKED)
    left = below(client, "recon", "spawn")
    client.send_signal(signal.SIGINT)
    told = client.communicate()[1].decode().splitlines()
    assert client.returncode == 130
    assert told[-1].endswith(f"recon batch --resume {out} does what is missing")
    assert_gone(left)


@slow
def test_a_job_that_fails_by_its_input_is_reported(batches, tmp_path):
    sources = [batches.folder / "scene", tmp_path / "nowhere"]
    words = ["batch", "pair", *sources, "--out", tmp_path / "out"]
    summary = ended(*words, "--workers", "1", code=1)
    assert counts(summary) == [1, 1, 0]
    assert summary["jobs"][0]["figures"]["disparity.bad.2.0"] < 5
    assert "nowhere" in summary["jobs"][1]["error"]
    assert (tmp_path / "out" / "report.html").is_file()
    assert not (tmp_path / "out" / "nowhere").exists()
    assert_refused(run(*words), "not empty", "--resume goes on with it")


@slow
def test_the_first_failure_ends_a_batch_that_fails_fast(batches, tmp_path):
    sources = [tmp_path / "nowhere", *(batches.folder / f"drive{n}" for n in range(DRIVES))]
    words, out = ["batch", "map", *sources, "--option=--no-mesh", "--out"], tmp_path / "out"
    fast = ended(*words, out, "--workers", "1", "--fail-fast", code=1)
    assert counts(fast) == [0, 1, DRIVES]
    # A job that had begun is killed; what it left is gone on with.
    assert counts(ended("batch", "--resume", out, "--workers", "1", code=1)) == [DRIVES, 1, 0]


@pytest.mark.parametrize(("words", "told"), [
    ("batch jobs.toml", "file does not exist"),
    ("batch mapp a", "unknown command"),
    ("batch map", "there is no source"),
    ("batch map a ./a", "two jobs have one name"),
    ("batch map a --option=--no-such", "No such option"),
    ("batch --resume nowhere", "holds no batch"),
    ("map DRIVE --workers 2 --poses DRIVE/poses.txt", "--poses or --prior is mapped in one"),
    ("map DRIVE --workers 2 --prior DRIVE/prior.txt", "--poses or --prior is mapped in one"),
    ("map DRIVE --workers 2 --set occupancy.keep_rays=false", "joined by their rays"),
    ("map DRIVE --scheduler nonsense", "nonsense: the scheduler cannot be reached"),
    ("map DRIVE --workers 2", "pip install 'recon-stereo[cluster]'"),
])  # fmt: skip
def test_what_cannot_be_asked_of_workers_is_refused_before_anything_runs(
    short, tmp_path, monkeypatch, words, told
):
    monkeypatch.chdir(tmp_path)
    if "pip" in told:
        monkeypatch.setitem(sys.modules, "distributed", None)
    assert_refused(run(*words.replace("DRIVE", str(short)).split()), told)
    assert list(tmp_path.iterdir()) == []


@pytest.fixture(scope="module")
def short(tmp_path_factory):
    drive = street_drive(tmp_path_factory.mktemp("short"), 3, 128)
    lines = (f"{n} 0 0 0 0 0 0 1\n" for n in range(-1, 9))
    (drive / "prior.txt").write_text("".join(lines))
    return drive


def test_options_that_say_nothing_together_are_wrong_usage(tmp_path):
    scheduler = ["--scheduler", "tcp://127.0.0.1:9"]
    for words in (["--workers", "2", *scheduler], ["--into", "run", *scheduler]):
        assert run("map", tmp_path, *words).code == 2


@contextmanager
def cluster(folder: Path, small: Path | None = None) -> Iterator[list[Client]]:
    """A scheduler, which writes its address to ``folder/scheduler.json``, and two workers.

    A folder ``small`` is full for the first worker, and for it alone.
    """
    folder.mkdir()
    place, dask = folder / "scheduler.json", [sys.executable, "-m", "dask"]
    head = ["--host", "127.0.0.1", "--port", "0", "--no-dashboard", "--scheduler-file", str(place)]
    line = [*dask, "worker", "--scheduler-file", str(place), "--nthreads", "1", "--no-dashboard"]
    started = [subprocess.Popen([*dask, "scheduler", *head], **QUIET)]
    try:
        wait_until(place.is_file, started[0], "address of the scheduler")
        first = line if small is None else in_small_disk(line, small)
        started += [subprocess.Popen(command, **QUIET) for command in (first, line)]
        with distributed.Client(scheduler_file=str(place)) as client:
            client.wait_for_workers(2, timeout=LONG_S)  # else one may get all jobs
        yield started
    finally:
        for process in reversed(started):
            for one in (*psutil.Process(process.pid).children(recursive=True), process):
                one.kill()
            process.wait()


def in_small_disk(line: list[str], folder: Path) -> list[str]:
    mount = f"mount -t tmpfs -o size=512k tmpfs {shlex.quote(str(folder))} && exec "
    return ["unshare", "--mount", "sh", "-c", mount + shlex.join(line)]


@slow
def test_a_job_whose_disk_is_full_is_done_by_another_worker(tmp_path):
    out = tmp_path / "out"
    out.mkdir()
    try:
        subprocess.run(in_small_disk(["true"], out), check=True, capture_output=True)
    except (OSError, subprocess.CalledProcessError) as error:
        pytest.skip(f"no disk can be mounted here: {error}")
    drives = [street_drive(tmp_path / f"drive{seed}", 16, seed=seed) for seed in range(2)]
    for drive in drives:
        ended("map", drive, "--no-mesh", "--threads", "1", "--out", f"{drive}-whole", "--quiet")
    with cluster(tmp_path / "cluster", small=out):
        where = ["--scheduler", tmp_path / "cluster" / "scheduler.json", "--out", out]
        options = ["--option=--no-mesh", "--threads", "1", *where]
        jobs = ended("batch", "map", *drives, *options)["jobs"]
    assert {job["state"] for job in jobs} == {"succeeded"}
    assert max(job["tries"] for job in jobs) > 1, "no job met the full disk"
    for drive in drives:
        assert content(out / drive.name) == content(Path(f"{drive}-whole"))


@slow
def test_a_scheduler_that_is_killed_is_one_line_and_another_one_finishes(tmp_path):
    drives = [str(street_drive(tmp_path / f"drive{n}", 16, seed=n)) for n in range(2)]
    out = tmp_path / "out"
    with cluster(tmp_path / "first") as (scheduler, *workers):
        where = ["--scheduler", str(tmp_path / "first" / "scheduler.json"), "--out", str(out)]
        words = ["batch", "map", *drives, *where, "--option=--no-mesh", "--threads", "1"]
        client = subprocess.Popen([*RECON, *words], **ASKED)
        wait_until(lambda: below(workers[0], JOB), client, "first job")
        jobs = [job for worker in workers for job in below(worker, JOB)]
        scheduler.kill()
        _, told = client.communicate(timeout=LONG_S)
        assert client.returncode == 1
        (line,) = told.decode().splitlines()
        assert line.startswith("error: the scheduler is gone")
        assert line.endswith(f"recon batch --resume {out} does what is missing")
        wait_until(  # nobody waits for them any more
            lambda: not any(j.is_running() and j.status() != psutil.STATUS_ZOMBIE for j in jobs),
            workers[0],
            "end of the jobs",
        )
    with cluster(tmp_path / "second"):
        where = ["--scheduler", tmp_path / "second" / "scheduler.json"]
        assert counts(ended("batch", "--resume", out, *where)) == [2, 0, 0]


class Pieces:
    def __init__(self, folder: Path) -> None:
        self.drive = street_drive(folder / "drive", 84, 192, smooth_edges=True)
        self.whole, self.pieces = folder / "whole", folder / "pieces"
        self.summaries = [
            ended(*self.words(self.whole)), ended(*self.words(self.pieces), "--workers", "2")
        ]  # fmt: skip

    def words(self, out: Path) -> list[str]:
        settings = ("checkpoints.every_frames=10", "submaps.length_m=8", "submaps.tile_m=25.6")
        options = [f"--set={text}" for text in settings]
        return ["map", str(self.drive), "--out", str(out), "--no-mesh", *options]

    def interrupted(self, out: Path) -> Client:
        """Begin a run by two workers; returns when a piece has committed something."""
        client = subprocess.Popen([*RECON, *self.words(out), "--workers", "2"], **ASKED)
        folder = out / ".partial" / ".state" / "pieces"
        wait_until(lambda: any(map(committed, folder.glob("[01]"))), client, "commit of a piece")
        return client


def committed(piece: Path) -> bool:
    if not begun(piece):
        return False
    with Map.open(piece / STATE) as map_:
        return map_.session().state() is not None


def keys(tree: Any) -> Any:
    """The names in a summary, with those of stages left out."""
    if not isinstance(tree, dict):
        return None
    return {name: keys(value) for name, value in tree.items() if name not in ("stages", "refused")}


@pytest.fixture(scope="module")
def pieces(tmp_path_factory):
    return Pieces(tmp_path_factory.mktemp("pieces"))


@slow
def test_a_run_in_pieces_has_the_form_of_one_in_one_piece(pieces):
    whole, found = pieces.summaries
    assert keys(found) == keys(whole)
    assert set(content(pieces.pieces)) == set(content(pieces.whole))
    assert not (pieces.pieces / ".partial").exists()
    assert found["frames"] == 84
    # In pictures this small, drift is mostly chance: `benchmarks/fleet.py long` compares it.
    assert all(one["trajectory"]["t_rel_percent"] < 2 for one in pieces.summaries)
    with Map.open(pieces.pieces) as map_:
        assert (len(map_.sessions), len(map_.session())) == (1, 84)
    record = json.loads((pieces.pieces / "run.json").read_text())
    assert [(one["first"], one["last"]) for one in record["pieces"]] == [(0, 42), (22, 84)]


@slow
def test_a_piece_that_is_killed_goes_on_to_the_same_files(pieces, tmp_path):
    client = pieces.interrupted(tmp_path / "out")
    below(client, JOB)[0].kill()
    _, told = client.communicate()
    assert client.returncode == 0, told
    assert content(tmp_path / "out") == content(pieces.pieces)
    record = json.loads((tmp_path / "out" / "run.json").read_text())
    assert sorted(one["tries"] for one in record["pieces"]) == [1, 2]


@slow
def test_a_killed_client_leaves_what_can_be_resumed(pieces, tmp_path):
    client = pieces.interrupted(tmp_path / "out")
    left = below(client, "recon", "spawn")
    client.kill()
    client.communicate()
    assert_gone(left)
    ended("map", "--resume", tmp_path / "out")
    assert content(tmp_path / "out") == content(pieces.pieces)
