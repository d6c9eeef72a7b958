"""Batches whose workers, jobs or client are killed end with the results of an undisturbed one."""

from __future__ import annotations

import json
import signal
import subprocess
import sys
import time
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from recon.core.values import RectifiedCamera
from recon.sources.synthetic import SyntheticSource
from recon.street.settings import StreetSettings
from tests.flow.test_killed_runs import content
from tests.flow.test_paper import write_scene
from tests.hostile.refusals import assert_refused, run
from tests.scenery.kitti import write_kitti
from tests.scenery.patience import LONG_S
from tests.scenery.planes import slanted_pair

psutil = pytest.importorskip("psutil")
pytest.importorskip("distributed")

CAMERA = RectifiedCamera(180.0, 55.0, 40.0, 65.0, 0.2, 120, 80, 24)
SETTINGS = ("checkpoints.every_frames=5", "submaps.length_m=4", "submaps.tile_m=12.8")
DRIVES, KILLS = 3, 10
JOBS = "".join(
    f'[[job]]\nname = "drive{n}"\ncommand = "map"\nsource = "drive{n}"\n'
    f'options = ["--no-mesh"]\nset = {list(SETTINGS)}\n'
    for n in range(DRIVES)
)
PAIR = '[[job]]\nname = "pair"\ncommand = "pair"\nsource = "scene"\n'


RECON = [sys.executable, "-m", "recon"]


class Batches:
    """Drives and a pair, and the results of an undisturbed batch."""

    def __init__(self, folder: Path) -> None:
        self.folder, self.jobs = folder, folder / "jobs.toml"
        self.jobs.write_text(JOBS + PAIR)
        for n in range(DRIVES):
            settings = StreetSettings(frames=24, width_px=256, height_px=96, focal_px=144.0, seed=n)
            write_kitti(SyntheticSource(settings), folder / f"drive{n}")
        write_scene(folder / "scene", slanted_pair(CAMERA, 1.5, (0.1, -0.1), seed=1))
        ended(self.command(folder / "unbroken"), DRIVES + 1)
        self.content = content_of_jobs(folder / "unbroken")

    def command(self, out: Path) -> list[str]:
        options = ["--workers", "2", "--threads", "1", "--retries", "30", "--json"]
        return [*RECON, "batch", str(self.jobs), "--out", str(out), *options]

    def finish(self, out: Path) -> None:
        """Resume until everything is there, and compare with the undisturbed batch."""
        ended([*RECON, "batch", "--resume", str(out), "--workers", "2", "--json"], DRIVES + 1)
        assert content_of_jobs(out) == self.content


def ended(command: list[str], succeeded: int, failed: int = 0, not_run: int = 0) -> dict[str, Any]:
    """Run a batch to its end; its summary."""
    done = subprocess.run(command, capture_output=True, check=False, text=True)
    assert done.returncode == (1 if failed else 0), done.stderr
    summary: dict[str, Any] = json.loads(done.stdout)
    counts = [summary[state] for state in ("succeeded", "failed", "not_run")]
    assert counts == [succeeded, failed, not_run]
    return summary


def content_of_jobs(out: Path) -> dict[str, bytes]:
    found = {}
    for job in sorted(path.parent for path in out.glob("*/run.json")):
        found |= {f"{job.name}/{name}": data for name, data in content(job).items()}
    return found


@pytest.fixture(scope="module")
def batches(tmp_path_factory: pytest.TempPathFactory) -> Batches:
    return Batches(tmp_path_factory.mktemp("batches"))


def below(client: subprocess.Popen[bytes], *words: str) -> list[psutil.Process]:
    """The processes that a client has started and whose command line has one of the words."""
    found = []
    for process in psutil.Process(client.pid).children(recursive=True):
        try:
            line = " ".join(process.cmdline())
        except psutil.Error:
            continue
        if any(word in line for word in words):
            found.append(process)
    return found


def wait_until(fact: Callable[[], object], client: subprocess.Popen[bytes], what: str) -> None:
    late = time.monotonic() + 300
    while not fact():
        assert client.poll() is None, f"the batch ended before {what}"
        assert time.monotonic() < late, f"no {what}"
        time.sleep(0.1)


@pytest.mark.slow
@pytest.mark.timeout(1800)
def test_workers_and_jobs_that_are_killed_at_random_change_nothing(
    batches: Batches, tmp_path: Path
) -> None:
    rng, kills, out = np.random.default_rng(0), 0, tmp_path / "out"
    client = subprocess.Popen(batches.command(out), stdout=subprocess.PIPE, stderr=subprocess.PIPE)
    wait_until(lambda: below(client, "recon.run.batch.guard"), client, "first job")
    while client.poll() is None and kills < KILLS:
        time.sleep(rng.uniform(0.5, 8.0))
        if client.poll() is None and (
            found := below(client, "recon.run.batch.guard", "multiprocessing.spawn")
        ):
            victim = found[rng.integers(len(found))]
            if victim.is_running():
                victim.send_signal(signal.SIGKILL)
                kills += 1
    printed, told = client.communicate()
    assert client.returncode == 0, told
    assert kills >= KILLS // 2, "too few processes were killed before the batch was done"
    assert sum(job["tries"] for job in json.loads(printed)["jobs"]) > DRIVES + 1
    batches.finish(out)


@pytest.mark.slow
@pytest.mark.timeout(1800)
def test_a_client_that_is_killed_leaves_no_process_and_what_is_missing_is_done(
    batches: Batches, tmp_path: Path
) -> None:
    out = tmp_path / "out"
    quiet = {"stdout": subprocess.DEVNULL, "stderr": subprocess.DEVNULL}
    client = subprocess.Popen(batches.command(out), **quiet)
    # One drive is done, another is being mapped.
    wait_until(lambda: list(out.glob("drive?/run.json")), client, "first result")
    wait_until(lambda: below(client, "recon.run.batch.guard"), client, "second job")
    done = {path: path.stat().st_mtime_ns for path in out.glob("*/run.json")}
    left = below(client, "recon", "spawn")
    client.kill()
    client.wait()
    _, alive = psutil.wait_procs(left, timeout=LONG_S)
    assert alive == []
    assert not (out / "summary.json").exists()
    batches.finish(out)
    assert {path: path.stat().st_mtime_ns for path in done} == done


@pytest.mark.slow
@pytest.mark.timeout(900)
def test_an_interrupted_batch_says_how_to_go_on(batches: Batches, tmp_path: Path) -> None:
    out = tmp_path / "out"
    # Whoever runs the tests in the background has them ignore SIGINT.
    start = (
        "import runpy, signal\n"
        "signal.signal(signal.SIGINT, signal.default_int_handler)\n"
        "runpy.run_module('recon', run_name='__main__', alter_sys=True)\n"
    )
    command = [sys.executable, "-c", start, *batches.command(out)[3:]]
    client = subprocess.Popen(command, stdout=subprocess.DEVNULL, stderr=subprocess.PIPE)
    wait_until(lambda: below(client, "recon.run.batch.guard"), client, "first job")
    left = below(client, "recon", "spawn")
    client.send_signal(signal.SIGINT)
    _, told = client.communicate()
    assert client.returncode == 130
    assert (
        told.decode().splitlines()[-1].endswith(f"recon batch --resume {out} does what is missing")
    )
    assert psutil.wait_procs(left, timeout=LONG_S)[1] == []


@pytest.mark.slow
@pytest.mark.timeout(900)
def test_a_job_that_fails_by_its_input_is_reported_and_the_exit_code_is_1(
    batches: Batches, tmp_path: Path
) -> None:
    sources = [str(batches.folder / "scene"), str(tmp_path / "nowhere")]
    words = ["batch", "pair", *sources, "--out", str(tmp_path / "out")]
    summary = ended([*RECON, *words, "--workers", "1", "--json"], succeeded=1, failed=1)
    assert summary["jobs"][0]["figures"]["disparity.bad.2.0"] < 5
    assert "nowhere" in summary["jobs"][1]["error"]
    assert (tmp_path / "out" / "report.html").is_file()
    assert not (tmp_path / "out" / "nowhere").exists()
    assert_refused(run(*words), "not empty", "--resume goes on with it")


@pytest.mark.slow
@pytest.mark.timeout(900)
def test_the_first_failure_ends_a_batch_that_fails_fast(batches: Batches, tmp_path: Path) -> None:
    sources = [
        str(tmp_path / "nowhere"),
        *(str(batches.folder / f"drive{n}") for n in range(DRIVES)),
    ]
    words = ["batch", "map", *sources, "--option=--no-mesh", "--out", str(tmp_path / "out")]
    options = ["--workers", "1", "--json"]
    ended([*RECON, *words, *options, "--fail-fast"], 0, failed=1, not_run=DRIVES)
    # A job that had begun is killed; what it left is gone on with.
    ended([*RECON, "batch", "--resume", str(tmp_path / "out"), *options], DRIVES, failed=1)


@pytest.mark.parametrize(
    ("words", "told"),
    [
        (["jobs.toml"], "file does not exist"),
        (["mapp", "a"], "unknown command"),
        (["map"], "there is no source"),
        (["map", "a", "./a"], "two jobs have one name"),
        (["map", "a", "--set", "matching.window_px=9"], "matching.sad.window_px"),
        (["map", "a", "--option=--no-such"], "No such option"),
        (["--resume", "nowhere"], "holds no batch"),
    ],
)
def test_what_is_no_batch_is_refused_before_anything_runs(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, words: Sequence[str], told: str
) -> None:
    monkeypatch.chdir(tmp_path)
    assert_refused(run("batch", *words), told)
    assert list(tmp_path.iterdir()) == []
