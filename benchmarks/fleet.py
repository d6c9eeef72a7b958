"""What a batch costs: throughput of workers on this machine, and of the scheduler with many.

``pairs`` runs rendered pairs as a batch with one and with two workers of one thread each, and with
one worker of two threads.

``scheduler`` runs jobs that only sleep on workers that share some other processes: the scheduler
and all its messages are real. What a job costs the scheduler is its processor time divided by the
number of jobs, after one job with which it has loaded what it needs. Heartbeats are in it, so it is
less where the crowded processes of the workers are faster; their time says nothing. One row is
printed for each number of workers, the last with the last number of jobs.

``long`` renders a drive of many small frames around a large block and maps it in one piece and on
workers (``recon map --scheduler``): time, accuracy, peak memory of each process, and what went from
the workers to others. Files are not counted: results stay in them.

Examples:
    python benchmarks/fleet.py pairs --jobs 12
    python benchmarks/fleet.py long --frames 2000 --workers 2
    python benchmarks/fleet.py scheduler --workers 10 100 1000 --jobs 2000 10000 100000 --seconds 4
"""

from __future__ import annotations

import argparse
import json
import os
import subprocess
import sys
import tempfile
import time
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from functools import partial
from pathlib import Path
from typing import Any

import checkout  # noqa: F401 - what is measured
import psutil
from distributed import Client, LocalCluster

from recon.core.machine import available_cores
from recon.core.values import RectifiedCamera
from recon.io.images.image import write_image
from recon.run.batch.cluster import Cluster, local_cluster
from recon.run.batch.job import Job, Outcome
from recon.sources.synthetic import SyntheticSource
from recon.street.settings import StreetScene
from tests.scenery.kitti import write_kitti
from tests.scenery.planes import slanted_pair

CAMERA = RectifiedCamera(700.0, 310.0, 180.0, 310.0, 0.2, 620, 360, 96)
FARM = """
import asyncio, sys
import dask
from distributed import Worker

# Each would look at all of this process, several times a second.
dask.config.set({
    "distributed.admin.system-monitor.interval": "1 day",
    "distributed.worker.profile.enabled": False,
})

async def main(address, count, folder):
    options = dict(nthreads=1, memory_limit=0, dashboard=False, local_directory=folder)
    workers = [Worker(address, **options) for _ in range(int(count))]
    for some in range(0, len(workers), 20):
        await asyncio.gather(*workers[some : some + 20])
    await asyncio.gather(*(worker.finished() for worker in workers))

asyncio.run(main(*sys.argv[1:]))
"""
"""Many workers as threads of one process."""
CROWD = 125
"""How many: beyond, its memory takes long to be looked through for garbage."""
SHAPES = ((1, 1), (2, 1), (1, 2))
"""Workers and threads of each."""


def main(arguments: Sequence[str] | None = None) -> None:
    options = parse(arguments)
    result = {"pairs": pairs, "scheduler": scheduler, "long": long}[options.what](options)
    print(json.dumps(result, indent=2))


def parse(arguments: Sequence[str] | None) -> argparse.Namespace:
    parser = argparse.ArgumentParser(description=__doc__.partition("\n")[0])
    parser.add_argument("what", choices=["pairs", "scheduler", "long"])
    parser.add_argument("--jobs", type=int, nargs="+", default=[12])
    parser.add_argument("--workers", type=int, nargs="+", default=[2], help="or simulated ones")
    parser.add_argument("--rounds", type=int, default=1, help="of pairs, one after the other")
    parser.add_argument("--frames", type=int, default=2000, help="of the long drive")
    parser.add_argument("--width", type=int, default=256, help="of its frames, in pixels")
    parser.add_argument("--drive", type=Path, help="folder of a long drive that is there already")
    parser.add_argument("--threads", type=int, default=1, help="of each process that maps")
    parser.add_argument("--seconds", type=float, default=0.0, help="that a simulated job sleeps")
    return parser.parse_args(arguments)


def pairs(options: argparse.Namespace) -> dict[str, Any]:
    """Throughput of a batch of pairs, for each number of workers and threads."""
    rounds = []
    with tempfile.TemporaryDirectory() as name:
        folder = Path(name)
        words = write_pair(folder)
        for n in range(options.rounds):
            (out := folder / str(n)).mkdir()
            rows = [measure(out, words, options.jobs[0], *shape) for shape in SHAPES]
            rounds.append({"rows": rows, "ratio to one worker": ratios(rows)})
            print(json.dumps(rounds[-1]), file=sys.stderr)
    return {"cores": available_cores(), "rounds": rounds}


def ratios(rows: Sequence[dict[str, Any]]) -> dict[str, float]:
    """Throughput of each row, as a multiple of the first."""
    one = rows[0]["jobs_per_hour"]
    return {f"{r['workers']}x{r['threads']}": round(r["jobs_per_hour"] / one, 2) for r in rows}


def write_pair(folder: Path) -> list[str]:
    """Render a pair; returns the words of its command."""
    pair = slanted_pair(CAMERA, 2.0, (0.1, -0.1)).pair
    for side in ("left", "right"):
        write_image(folder / f"{side}.png", getattr(pair, side))
    camera = ["--focal", str(CAMERA.focal_px), "--baseline", str(CAMERA.baseline_m)]
    return ["pair", str(folder / "left.png"), str(folder / "right.png"), *camera]


def measure(
    folder: Path, words: list[str], jobs: int, workers: int, threads: int
) -> dict[str, Any]:
    """Run the jobs; the first of each worker, which waits for the disk, is not counted."""
    line = (*words, "--threads", str(threads))
    out = folder / f"{workers}x{threads}"
    with local_cluster(workers) as cluster:
        warm = [Job(f"w{n}", "pair", "", line, True, str(folder)) for n in range(workers)]
        check(cluster, warm, out)
        begun = time.perf_counter()
        todo = [Job(f"j{n}", "pair", "", line, True, str(folder)) for n in range(jobs)]
        seconds = check(cluster, todo, out)
        took = time.perf_counter() - begun
    return {
        "workers": workers,
        "threads": threads,
        "jobs": jobs,
        "seconds": round(took, 1),
        "seconds_of_a_job": round(seconds / jobs, 2),
        "jobs_per_hour": round(3600 * jobs / took, 1),
    }


def check(cluster: Cluster, jobs: list[Job], out: Path) -> float:
    """Run jobs that must succeed; returns the sum of their times."""
    outcomes = [outcome for _, outcome in cluster.run(jobs, out)]
    failed = [outcome.error for outcome in outcomes if outcome.state != "succeeded"]
    if failed:
        sys.exit(failed[0])
    return sum(outcome.seconds for outcome in outcomes)


def long(options: argparse.Namespace) -> dict[str, Any]:
    """A long drive in one piece, and in pieces on workers."""
    with tempfile.TemporaryDirectory() as name:
        folder = Path(name)
        drive = options.drive or folder / "drive"
        if not drive.is_dir():
            write_kitti(SyntheticSource(street(options)), drive, grey=False)
        line = [sys.executable, "-m", "recon", "map", str(drive), "--no-mesh", "--json", "--quiet"]
        line += ["--threads", str(options.threads)]
        alone = run_of(line, folder / "alone", [])
        with LocalCluster(  # type: ignore[no-untyped-call]
            options.workers[0], threads_per_worker=1, dashboard_address=None
        ) as local:
            where = ["--scheduler", local.scheduler_address]
            spread = run_of(line, folder / "spread", where)
            with Client(local) as client:  # type: ignore[no-untyped-call]
                spread["bytes_given_by_workers"] = sum(client.run(given).values())
    faster = round(alone["seconds"] / spread["seconds"], 2)
    return {"frames": alone["frames"], "alone": alone, "spread": spread, "times as fast": faster}


def street(options: argparse.Namespace) -> StreetScene:
    """A drive around a block so large that its first street is seen again by another worker."""
    long_m, short_m = 0.28 * options.frames, 0.2 * options.frames
    return StreetScene(
        path="block",
        block_m=(max(100.0, long_m), max(70.0, short_m)),
        frames=options.frames,
        width_px=options.width,
        height_px=options.width * 3 // 8,
        focal_px=0.5625 * options.width,
    )


def run_of(line: list[str], out: Path, more: list[str]) -> dict[str, Any]:
    """Map the drive; what it took, and how good it is."""
    command = [*line, "--out", str(out), *more]
    before = os.times()
    done = subprocess.run(command, capture_output=True, text=True, check=False)
    after = os.times()
    if done.returncode:
        sys.exit(done.stderr)
    summary = json.loads(done.stdout)
    pieces = json.loads((out / "run.json").read_text()).get("pieces", [])
    loops = summary.get("loops", {})
    return {
        "frames": summary["frames"],
        "seconds": summary["seconds"],
        "stages": summary["stages"],
        "cpu_seconds_of_client": round(after[2] + after[3] - before[2] - before[3], 1),
        "t_rel_percent": summary["trajectory"]["t_rel_percent"],
        "ate_m": summary["trajectory"]["ate_m"],
        "loops": loops.get("closed"),
        "points": summary["points"],
        "peak_memory_mb": summary["peak_memory_mb"],
        "pieces": [
            {name: piece[name] for name in ("first", "last", "seconds", "peak_memory_mb")}
            for piece in pieces
        ],
    }


def given(dask_worker: Any) -> int:
    """Bytes of results that a worker has given to other workers and to the client."""
    return int(dask_worker.transfer_outgoing_bytes_total)


def scheduler(options: argparse.Namespace) -> dict[str, Any]:
    """Processor time of the scheduler for each of many jobs that sleep, for several sizes."""
    rows = []
    for n, workers in enumerate(options.workers):
        jobs = options.jobs[min(n, len(options.jobs) - 1)]
        rows.append(simulated(workers, jobs, options.seconds))
        print(json.dumps(rows[-1]), file=sys.stderr)
    return {"cores": available_cores(), "rows": rows}


def simulated(workers: int, count: int, seconds: float) -> dict[str, Any]:
    """Run jobs that sleep on simulated workers; what each costs, and where that ends."""
    jobs = [Job(f"j{n}", "sleep", "", (str(seconds),), True, "") for n in range(count)]
    with (
        crowd(workers) as (address, process),
        Client(address) as client,  # type: ignore[no-untyped-call]
    ):
        cluster, per_job, took = Cluster(client, sleep), 0.0, 0.0
        while len(cluster.workers) < workers:
            time.sleep(1)
        list(cluster.run([Job("first", "sleep", "", ("0",), True, "")], Path()))
        idle = idle_ratio(process)
        before, begun, own = process_s(process), time.perf_counter(), time.process_time()
        for done, _ in enumerate(cluster.run(jobs, Path()), start=1):
            took = time.perf_counter() - begun
            per_job = (process_s(process) - before) / done
            if done % 5000 == 0:
                told = {"jobs": done, "seconds": round(took, 1), "idle": round(idle, 3)}
                told["scheduler_ms_per_job"] = round(1e3 * per_job, 3)
                print(json.dumps(told), file=sys.stderr, flush=True)
        own = time.process_time() - own
        memory = process.memory_info().rss / 1e6
    most = 1 / per_job
    return {
        "workers": workers,
        "jobs": count,
        "seconds_of_a_job": seconds,
        "seconds": round(took, 1),
        "scheduler_ms_per_job": round(1e3 * per_job, 3),
        "client_ms_per_job": round(1e3 * own / count, 3),
        "scheduler_share_when_idle": round(idle, 3),
        "scheduler_mb": round(memory),
        "jobs_per_second_at_most": round(most),
        "seconds_of_a_job_at_least": round(workers / most, 2),
        "workers_busy_with_jobs_of_60_s": round(60 * most),
    }


def sleep(job: Job, folder: str) -> Outcome:
    """What a simulated worker does."""
    del folder
    time.sleep(float(job.words[0]))
    return Outcome("succeeded")


def idle_ratio(process: psutil.Process, seconds: float = 10.0) -> float:
    """Fraction of a core that the heartbeats of the workers take."""
    before = process_s(process)
    time.sleep(seconds)
    return (process_s(process) - before) / seconds


def process_s(process: psutil.Process) -> float:
    times = process.cpu_times()
    return float(times.user + times.system)


@contextmanager
def crowd(workers: int) -> Iterator[tuple[str, psutil.Process]]:
    """A scheduler in a process of its own, and the workers in others; its address and process."""
    with tempfile.TemporaryDirectory() as name:
        place = Path(name) / "scheduler.json"
        start = partial(subprocess.Popen, stdout=subprocess.DEVNULL, stderr=subprocess.DEVNULL)
        dask = [sys.executable, "-m", "dask"]
        started: list[subprocess.Popen[str]] = []
        try:
            head = ["--host", "127.0.0.1", "--port", "0", "--no-dashboard", "--scheduler-file"]
            started.append(start([*dask, "scheduler", *head, str(place)]))
            while not place.is_file() or not place.read_text():
                time.sleep(0.1)
            address = json.loads(place.read_text())["address"]
            for first in range(0, workers, CROWD):
                count = min(CROWD, workers - first)
                farm = [sys.executable, "-c", FARM, address, str(count), name]
                started.append(start(farm))
            yield address, psutil.Process(started[0].pid)
        finally:
            for process in reversed(started):
                process.kill()
                process.wait()


if __name__ == "__main__":
    main()
