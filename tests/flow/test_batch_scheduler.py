"""A batch on a scheduler of its own goes on after that has died, or a worker's disk is full."""

from __future__ import annotations

import json
import shlex
import subprocess
import sys
import time
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

import pytest

from recon.sources.synthetic import SyntheticSource
from recon.street.settings import StreetSettings
from tests.flow.test_batch import below, wait_until
from tests.flow.test_killed_runs import content
from tests.scenery.kitti import write_kitti
from tests.scenery.patience import LONG_S

psutil = pytest.importorskip("psutil")
distributed = pytest.importorskip("distributed")
QUIET = {"stdout": subprocess.DEVNULL, "stderr": subprocess.DEVNULL}


SMALL_DISK = "mount -t tmpfs -o size=512k tmpfs {} && exec "
"""What gives a worker a small disk of its own in place of a folder."""


@contextmanager
def cluster(folder: Path, small: Path | None = None) -> Iterator[list[subprocess.Popen[bytes]]]:
    """A scheduler, which writes its address to a file, and two workers.

    Args:
        folder: For its files.
        small: A folder that is full for the first worker, and for it alone.
    """
    folder.mkdir()
    place, dask = folder / "scheduler.json", [sys.executable, "-m", "dask"]
    head = ["--host", "127.0.0.1", "--port", "0", "--no-dashboard", "--scheduler-file", str(place)]
    worker = ["--scheduler-file", str(place), "--nthreads", "1", "--no-dashboard"]
    started = [subprocess.Popen([*dask, "scheduler", *head], **QUIET)]
    try:
        wait_until(place.is_file, started[0], "address of the scheduler")
        line = [*dask, "worker", *worker]
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
    script = SMALL_DISK.format(shlex.quote(str(folder))) + shlex.join(line)
    return ["unshare", "--mount", "sh", "-c", script]


def street(seed: int, drive: Path) -> Path:
    settings = StreetSettings(frames=16, width_px=256, height_px=96, focal_px=144.0, seed=seed)
    write_kitti(SyntheticSource(settings), drive)
    return drive


@pytest.mark.slow
@pytest.mark.timeout(1800)
def test_a_job_whose_disk_is_full_is_done_by_another_worker(tmp_path: Path) -> None:
    out = tmp_path / "out"
    out.mkdir()
    try:
        subprocess.run(in_small_disk(["true"], out), check=True, capture_output=True)
    except (OSError, subprocess.CalledProcessError) as error:
        pytest.skip(f"no disk can be mounted here: {error}")
    drives = [str(street(seed, tmp_path / f"drive{seed}")) for seed in range(2)]
    program, options = [sys.executable, "-m", "recon"], ["--no-mesh", "--threads", "1"]
    for drive in drives:
        command = [*program, "map", drive, *options, "--out", f"{drive}-whole", "--quiet"]
        subprocess.run(command, check=True, capture_output=True)
    with cluster(tmp_path / "cluster", small=out):
        where = ["--scheduler", str(tmp_path / "cluster" / "scheduler.json"), "--out", str(out)]
        line = ["batch", "map", *drives, "--option=--no-mesh", "--threads", "1", *where, "--json"]
        done = subprocess.run([*program, *line], capture_output=True, check=False)
    assert done.returncode == 0, done.stderr
    jobs = json.loads(done.stdout)["jobs"]
    assert {job["state"] for job in jobs} == {"succeeded"}
    assert max(job["tries"] for job in jobs) > 1, "no job met the full disk"
    for drive in drives:
        assert content(out / Path(drive).name) == content(Path(f"{drive}-whole"))


@pytest.mark.slow
@pytest.mark.timeout(1800)
def test_a_scheduler_that_is_killed_is_one_line_and_another_one_finishes(tmp_path: Path) -> None:
    drives = [street(seed, tmp_path / f"drive{seed}") for seed in range(2)]
    program, out = [sys.executable, "-m", "recon", "batch"], tmp_path / "out"
    with cluster(tmp_path / "first") as (scheduler, *workers):
        where = ["--scheduler", str(tmp_path / "first" / "scheduler.json"), "--out", str(out)]
        client = subprocess.Popen(
            [*program, "map", *map(str, drives), *where, "--option=--no-mesh", "--threads", "1"],
            stdout=subprocess.DEVNULL,
            stderr=subprocess.PIPE,
        )
        wait_until(lambda: below(workers[0], "recon.run.batch.guard"), client, "first job")
        jobs = [job for worker in workers for job in below(worker, "recon.run.batch.guard")]
        scheduler.kill()
        _, told = client.communicate(timeout=300)
        assert client.returncode == 1
        (line,) = told.decode().splitlines()
        assert line.startswith("error: the scheduler is gone")
        assert line.endswith(f"recon batch --resume {out} does what is missing")
        late = time.monotonic() + 120
        while any(job.is_running() and job.status() != psutil.STATUS_ZOMBIE for job in jobs):
            assert time.monotonic() < late, "a job goes on without anybody who waits for it"
            time.sleep(0.2)
    with cluster(tmp_path / "second"):
        done = subprocess.run(
            [*program, "--resume", str(out), "--json", "--scheduler",
             str(tmp_path / "second" / "scheduler.json")],
            capture_output=True, check=False,
        )  # fmt: skip
    assert done.returncode == 0, done.stderr
    summary = json.loads(done.stdout)
    assert (summary["succeeded"], summary["failed"]) == (2, 0)
