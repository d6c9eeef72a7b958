"""What work of a checkout costs: seconds, those of processors, and StereoBM as a unit of both.

A machine that is shared or slower makes both longer, and so it does StereoBM: figures in units of
it are those of the program. `two_checkouts.py` compares two checkouts by this file.
"""

from __future__ import annotations

import json
import os
import resource
import statistics
import subprocess
import sys
import tempfile
import time
from collections import deque
from collections.abc import Sequence
from pathlib import Path
from typing import Any, Final, NamedTuple

import cv2
import numpy as np
import psutil

SIZE_PX: Final = (375, 1242)  # rows and columns of a KITTI pair
DISPARITIES: Final = 128
WINDOW_PX: Final = 11
STEREO_BM_RUNS: Final = 9
PAIR_RUNS: Final = 3
RATE: Final = 1  # of the drive's own time, 10 Hz of KITTI's


class Cost(NamedTuple):
    """What some work took."""

    seconds: float
    processor_s: float


def stereo_bm_s() -> float:
    """Processor seconds of OpenCV's StereoBM of one KITTI pair, on one thread: the median."""
    rng = np.random.default_rng(0)
    scene = cv2.GaussianBlur(rng.integers(0, 256, SIZE_PX, dtype=np.uint8), (0, 0), 1.5)
    scene = cv2.normalize(scene, None, 0, 255, cv2.NORM_MINMAX)
    right, matcher = np.roll(scene, -40, axis=1), cv2.StereoBM.create(DISPARITIES, WINDOW_PX)
    threads, taken = cv2.getNumThreads(), []
    cv2.setNumThreads(1)
    for _ in range(STEREO_BM_RUNS):
        start = time.process_time()
        matcher.compute(scene, right)
        taken.append(time.process_time() - start)
    cv2.setNumThreads(threads)
    return statistics.median(taken)


def mapped(checkout: Path, drive: Path) -> tuple[dict[str, Cost], dict[str, Any]]:
    """Map a drive with mesh and report; the cost of its parts, and its summary."""
    begun = _now()
    with tempfile.TemporaryDirectory() as folder:
        out = Path(folder) / "run"
        frames, summary = watched(checkout, drive, out)
        ended = _now()
        size = sum(path.stat().st_size for path in out.rglob("*") if path.is_file())
    first, last, steps = frames[0], frames[-1], max(len(frames) - 1, 1)
    costs = {
        "before the first frame": Cost(first.seconds - begun.seconds, first.processor_s),
        "a frame": Cost(*((b - a) / steps for a, b in zip(first, last, strict=True))),
        "whole run": Cost(*(b - a for a, b in zip(begun, ended, strict=True))),
    }
    return costs, {**summary, "run_folder_mb": size / 1e6}


def watched(
    checkout: Path, drive: Path, out: Path, *options: str
) -> tuple[list[Cost], dict[str, Any]]:
    """Map a drive; the time, and what the process had taken, when each frame was mapped.

    The second is the summary of the run.
    """
    words = ["map", str(drive.resolve()), "--out", str(out), "--json", "--verbose", *options]
    how: dict[str, Any] = {"stdout": subprocess.PIPE, "stderr": subprocess.STDOUT}
    frames, said = list[Cost](), deque[bytes](maxlen=5)
    with subprocess.Popen(command(*words), **inside(checkout), **how) as process:
        own = psutil.Process(process.pid)
        for line in process.stdout or ():
            said.append(line)
            if line.startswith(b'{"event": "frame"'):
                used = own.cpu_times()
                frames.append(Cost(time.perf_counter(), used.user + used.system))
    if process.returncode:
        raise SystemExit(b"".join(said).decode(errors="replace"))
    return frames, json.loads((out / "summary.json").read_text())


def pair(checkout: Path, drive: Path) -> Cost:
    """`recon pair` of the first pair of a drive in KITTI's layout, when all is compiled."""
    left, right = (sorted((drive / name).glob("*.png"))[0] for name in ("image_0", "image_1"))
    with tempfile.TemporaryDirectory() as folder:
        words = [str(left.resolve()), str(right.resolve()), "--calib"]
        words.append(str((drive / "calib.txt").resolve()))
        runs = [
            called(checkout, "pair", *words, "--quiet", "--out", f"{folder}/{n}")
            for n in range(PAIR_RUNS)
        ]
    return Cost(*map(statistics.median, zip(*runs, strict=True)))


def live(checkout: Path, drive: Path) -> dict[str, Any]:
    """What `recon live` says of a drive at its own rate: latencies, and frames matched in time."""
    with tempfile.TemporaryDirectory() as folder:
        words = ["live", str(drive.resolve()), "--rate", f"{RATE}", "--json", "--out"]
        done = subprocess.run(
            command(*words, f"{folder}/run"), **inside(checkout), capture_output=True, check=True
        )
    return dict(json.loads(done.stdout)["live"])


def called(checkout: Path, *words: str) -> Cost:
    """Run a command of a checkout."""
    begun = _now()
    subprocess.run(command(*words), **inside(checkout), capture_output=True, check=True)
    return Cost(*(after - before for before, after in zip(begun, _now(), strict=True)))


def command(*words: str) -> Sequence[str]:
    return [sys.executable, "-m", "recon", *words]


def inside(checkout: Path) -> dict[str, Any]:
    return {"cwd": checkout, "env": {**os.environ, "PYTHONPATH": str(checkout)}}


def _now() -> Cost:
    """The time, and what processes that have ended took."""
    ended = resource.getrusage(resource.RUSAGE_CHILDREN)
    return Cost(time.perf_counter(), ended.ru_utime + ended.ru_stime)
