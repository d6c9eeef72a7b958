"""A drive that is mapped while its images arrive: how late the poses are, and what is left out.

The drive is played at its own time stamps by `recon live`, in a process of its own for each rate.
`latency_ms` is the time from when an image is due to its pose, `longest_gap` the most frames of the
recording from one pose to the next. `cpu_ms_per_frame` is the processor time of a frame that nobody
hurries, on one thread: up to `odometry` what comes before its pose, then what follows. `path` is
the drift of the odometry of `recon live`, on rough disparities, and of that of `recon map`.

Without DRIVE, a rendered street is played.

Example: python benchmarks/live.py DRIVE --rates 1 2 --json
"""

from __future__ import annotations

import argparse
import json
import subprocess
import sys
import tempfile
import time
from collections import defaultdict
from collections.abc import Callable, Sequence
from functools import partial
from pathlib import Path
from typing import Any

import checkout  # noqa: F401 - what is measured
import cv2
import numpy as np
from altered_drives import alterations, write_kitti

from recon.commands.config import ReconConfig, load_config
from recon.commands.demo import demo_source
from recon.core.machine import available_cores
from recon.core.values import Trajectory
from recon.core.work import serial_algebra
from recon.evaluation.trajectory import associate, evaluate_trajectory
from recon.io.trajectory import read_tum
from recon.odometry.protocol import OdometryFrame
from recon.odometry.registry import make_odometry
from recon.sources.registry import open_source
from recon.sources.source import StereoSource
from recon.stereo.frame import FrameReconstructor

SAME_TIME_S = 0.01


def main(arguments: Sequence[str] | None = None) -> None:
    options = parse(arguments)
    config = load_config(None, options.set)
    with tempfile.TemporaryDirectory() as folder:
        drive = options.drive
        if drive is None:
            drive = Path(folder) / "street"
            write_kitti(alterations(demo_source(config))["as it is"], drive)
        source = open_source(drive)
        result = {"drive": source.name, "frames": len(source), "cores": available_cores()}
        result["rates"] = {
            f"{rate:g}": played(drive, source, rate, Path(folder) / f"at {rate:g}", options)
            for rate in options.rates
        }
    if not options.only_live:
        result |= quietly(source, config)
    print(json.dumps(result, indent=2) if options.json else table(result))


def parse(arguments: Sequence[str] | None) -> argparse.Namespace:
    parser = argparse.ArgumentParser(description=__doc__.partition("\n")[0])
    parser.add_argument(
        "drive", type=Path, nargs="?", help="drive with true poses; a rendered street"
    )
    parser.add_argument("--rates", type=float, nargs="+", default=[1.0], help="as `recon live`")
    parser.add_argument("--map", type=Path, help="find the drive in this map instead")
    parser.add_argument("--only-live", action="store_true", help="without processor times")
    parser.add_argument("--json", action="store_true", help="print JSON instead of a table")
    parser.add_argument("--set", action="append", default=[], help="a setting of recon live")
    return parser.parse_args(arguments)


def played(
    drive: Path, source: StereoSource, rate: float, out: Path, options: argparse.Namespace
) -> dict[str, Any]:
    """What `recon live` says of a drive, and how good its path is."""
    command = [sys.executable, "-m", "recon", "live", str(drive), "--rate", f"{rate:g}"]
    command += ["--json", "--out", str(out)]
    command += ["--map", str(options.map)] if options.map else []
    command += [part for text in options.set for part in ("--set", text)]
    done = subprocess.run(command, capture_output=True, text=True, check=False)
    if done.returncode:
        return {"error": done.stderr.strip()}
    summary = json.loads(done.stdout)
    path = read_tum(out / "trajectory_tum.txt")
    figures = {**summary["live"], "peak_memory_mb": summary["peak_memory_mb"]}
    figures["longest_gap"] = int(np.diff(frames_of(path, source)).max(initial=0))
    if options.map:
        states = ("frames", "frames_tracking", "frames_coasting")
        return figures | {name: summary[name] for name in states}
    return figures | {"warnings": summary["warnings"], **errors(path, source)}


def frames_of(path: Trajectory, source: StereoSource) -> np.ndarray:
    """Numbers of the frames of the recording that have a pose."""
    truth = true_path(source)
    return np.searchsorted(truth.timestamps_s + SAME_TIME_S, path.timestamps_s)


def true_path(source: StereoSource) -> Trajectory:
    if source.truth is None or source.truth.trajectory is None:
        raise SystemExit(f"{source.name}: has no true poses")
    return source.truth.trajectory


def errors(path: Trajectory, source: StereoSource) -> dict[str, float]:
    """Drift of a path, and its length relative to the true one."""
    found, true = associate(path, true_path(source), SAME_TIME_S)
    drift = evaluate_trajectory(found, true)
    return {
        "t_rel_percent": round(drift.t_rel_percent, 3),
        "r_rel_deg_per_100m": round(drift.r_rel_deg_per_100m, 3),
        "scale": round(found.path_length_m / true.path_length_m, 4),
    }


def quietly(source: StereoSource, config: ReconConfig) -> dict[str, Any]:
    """Processor time of each stage of a frame, and the drift of both odometries."""
    cv2.setNumThreads(1)
    frames = FrameReconstructor(source.calibration, config, threads=1)
    rough = make_odometry("visual", config.odometry)
    exact = make_odometry(config.odometry.method, config.odometry)
    seconds, poses = defaultdict[str, float](float), []
    pairs = iter(source)
    with serial_algebra():
        while (pair := timed(seconds, "read", lambda: next(pairs, None))) is not None:
            rectified, near = timed(seconds, "rough match", partial(frames.match_roughly, pair))
            hurried = OdometryFrame(rectified, near, rough=True)
            found = timed(seconds, "odometry", partial(rough.register, hurried))
            make = partial(frames.reconstruct_rectified, rectified)
            frame = timed(seconds, "exact match, cloud", make)
            patient = exact.register(OdometryFrame(frame.pair, frame.disparity))
            poses.append((found.T_world_camera, patient.T_world_camera))
    count, times_s = len(poses), true_path(source).timestamps_s
    paths = (Trajectory(np.stack(path), times_s) for path in zip(*poses, strict=True))
    drift = (errors(path, source) for path in paths)
    return {
        "cpu_ms_per_frame": {name: round(1e3 * s / count, 1) for name, s in seconds.items()},
        "path": dict(zip(("rough", "exact"), drift, strict=True)),
    }


def timed(seconds: dict[str, float], name: str, work: Callable[[], Any]) -> Any:
    """What the work gives; its processor time is added."""
    before_s = time.process_time()
    result = work()
    seconds[name] += time.process_time() - before_s
    return result


def table(result: dict[str, Any]) -> str:
    """The figures for people: one line each."""
    lines = []
    for key, value in result.items():
        parts = value.items() if isinstance(value, dict) else (("", value),)
        lines += [f"{key} {name}".strip().ljust(32) + str(figures) for name, figures in parts]
    return "\n".join(lines)


if __name__ == "__main__":
    main()
