"""A batch on a scheduler of its own goes on after that has died."""

from __future__ import annotations

import json
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
from tests.scenery.kitti import write_kitti

psutil = pytest.importorskip("psutil")
pytest.importorskip("distributed")
QUIET = {"stdout": subprocess.DEVNULL, "stderr": subprocess.DEVNULL}


@contextmanager
def cluster(folder: Path) -> Iterator[list[subprocess.Popen[bytes]]]:
    """A scheduler, which writes its address to a file, and two workers."""
    folder.mkdir()
    place, dask = folder / "scheduler.json", [sys.executable, "-m", "dask"]
    head = ["--host", "127.0.0.1", "--port", "0", "--no-dashboard", "--scheduler-file", str(place)]
    worker = ["--scheduler-file", str(place), "--nthreads", "1", "--no-dashboard"]
    started = [subprocess.Popen([*dask, "scheduler", *head], **QUIET)]
    try:
        wait_until(place.is_file, started[0], "address of the scheduler")
        started += [subprocess.Popen([*dask, "worker", *worker], **QUIET) for _ in range(2)]
        yield started
    finally:
        for process in reversed(started):
            for one in (*psutil.Process(process.pid).children(recursive=True), process):
                one.kill()
            process.wait()


@pytest.mark.slow
@pytest.mark.timeout(1800)
def test_a_scheduler_that_is_killed_is_one_line_and_another_one_finishes(tmp_path: Path) -> None:
    drives = [tmp_path / "drive0", tmp_path / "drive1"]
    for seed, drive in enumerate(drives):
        street = StreetSettings(frames=16, width_px=256, height_px=96, focal_px=144.0, seed=seed)
        write_kitti(SyntheticSource(street), drive)
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
