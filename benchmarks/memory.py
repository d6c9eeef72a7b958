"""Peak memory of `recon map` on short and long drives, and of commands that reuse its runs.

A street that repeats every 50 m is rendered once and driven along for any number of frames, so
the map grows with every frame while the images repeat. Each drive is mapped in a separate process
and its peak resident memory is reported; ``libraries`` is the peak for a drive of a few frames,
where the map is negligible.

Examples:
    python benchmarks/memory.py --json --frames 1000 --frames 4000
    python benchmarks/memory.py --json --frames 600 --frames 2400 --again mesh --again occupancy
    python benchmarks/memory.py --json --frames 1000 --frames 4000 --again merge --again localize
"""

from __future__ import annotations

import argparse
import json
import subprocess
import sys
import tempfile
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import checkout  # noqa: F401 - what is measured
import numpy as np

from recon.core.values import Trajectory
from recon.io.atomic import write_text
from recon.io.trajectory import write_kitti_poses
from recon.sources.synthetic import SyntheticSource
from recon.street.settings import StreetScene
from tests.scenery.kitti import write_kitti

FRAMES = (1000, 4000)
LIBRARIES_FRAMES = 8
COMPILING_FRAMES = 60
REPEAT_M = 50.0
STEP_M = 0.5
CAMERAS = ("image_0", "image_1")


def main(arguments: Sequence[str] | None = None) -> None:
    options = parse(arguments)
    with tempfile.TemporaryDirectory(dir=options.folder) as folder:
        period = render_period(Path(folder) / "period", options.width)
        counts = sorted(set(options.frames or FRAMES))
        # The first run may compile kernels, which takes extra memory.
        measure(period, COMPILING_FRAMES, options)
        rows = [measure(period, count, options) for count in (LIBRARIES_FRAMES, *counts)]
    shortest, longest = rows[1], rows[-1]
    result = {
        "picture": [options.width, height_of(options.width)],
        "mesh": options.mesh,
        "settings": options.set,
        "libraries": rows[0],
        "drives": rows[1:],
        "longest / shortest": ratio(longest["peak_mb"], shortest["peak_mb"]),
        "longest / shortest, libraries aside": ratio(
            longest["peak_mb"] - rows[0]["peak_mb"], shortest["peak_mb"] - rows[0]["peak_mb"]
        ),
    }
    for name in options.again:
        peaks = (row["again"][name]["peak_mb"] for row in (longest, shortest))
        result[f"longest / shortest, recon {name}"] = ratio(*peaks)
    print(json.dumps(result, indent=2) if options.json else table(result))


def parse(arguments: Sequence[str] | None) -> argparse.Namespace:
    parser = argparse.ArgumentParser(description=__doc__.partition("\n")[0])
    parser.add_argument("--json", action="store_true", help="print JSON instead of a table")
    parser.add_argument(
        "--frames", action="append", default=[], type=int, help="length of a drive; repeatable"
    )
    parser.add_argument("--width", type=int, default=320, help="of the pictures, pixels")
    parser.add_argument("--mesh", action="store_true", help="also reconstruct a surface")
    parser.add_argument(
        "--again",
        action="append",
        default=[],
        choices=["mesh", "occupancy", "merge", "localize"],
        help="also what this command takes for the run of each drive; repeatable. merge: with the "
        "run of its first frames; localize: those in its map",
    )
    parser.add_argument("--set", action="append", default=[], metavar="KEY=VALUE")
    parser.add_argument("--folder", type=Path, help="where to work; 2 MB for each frame at most")
    return parser.parse_args(arguments)


def render_period(folder: Path, width_px: int) -> Path:
    """Render a drive along one period of the street, in the KITTI layout."""
    period = round(REPEAT_M / STEP_M)
    settings = StreetScene(
        # Two more periods, so that the last image shows no end of the street.
        frames=3 * period,
        speed_m_per_frame=STEP_M,
        path="straight",
        repeat_m=REPEAT_M,
        sway=0.0,
        width_px=width_px,
        height_px=height_of(width_px),
        focal_px=0.57 * width_px,
    )
    write_kitti(_Beginning(settings, period), folder)
    return folder


class _Beginning(SyntheticSource):
    """A synthetic drive cut to its first frames."""

    def __init__(self, settings: StreetScene, length: int) -> None:
        super().__init__(settings)
        self._length = length

    def __len__(self) -> int:
        return self._length


def height_of(width_px: int) -> int:
    return round(0.375 * width_px)


def measure(period: Path, frames: int, options: argparse.Namespace) -> dict[str, Any]:
    """Map a drive of ``frames`` frames in a separate process."""
    drive, out = period.parent / f"drive_{frames}", period.parent / f"run_{frames}"
    repeat(period, drive, frames)
    settings = [part for text in options.set for part in ("--set", text)]
    mesh = [] if options.mesh else ["--no-mesh"]
    summary = run_recon("map", drive, out, [*mesh, *settings])
    again = options.again if frames > COMPILING_FRAMES else ()
    files_mb = sum(path.stat().st_size for path in out.rglob("*") if path.is_file()) / 1e6
    return {
        "frames": frames,
        "peak_mb": summary["peak_memory_mb"],
        "path_m": round(summary["path_length_m"], 1),
        "points": summary["points"],
        "voxels": summary["voxels"],
        "files_mb": round(files_mb, 1),
        "seconds": summary["seconds"],
        "stages": summary["stages"],
        "again": {name: make_again(name, out) for name in again},
    }


def make_again(command: str, run: Path) -> dict[str, Any]:
    """Run a command on a finished run; its cost."""
    source, more = run, list[str]()
    if command == "merge":
        more = [str(run.with_name(f"run_{COMPILING_FRAMES}")), "--no-mesh"]
    elif command == "localize":
        source = run.with_name(f"drive_{COMPILING_FRAMES}")
        # The street repeats: without it, each frame would be looked for in all of the map.
        more = ["--map", str(run), "--start", "0,0,0"]
    summary = run_recon(command, source, run.with_name(f"{run.name}_{command}"), more)
    names = {"peak_mb": "peak_memory_mb", "seconds": "seconds", "stages": "stages"}
    figures = {name: summary[key] for name, key in names.items()}
    return figures | {key: summary[key] for key in ("frames_tracking",) if key in summary}


def run_recon(command: str, source: Path, out: Path, options: list[str]) -> dict[str, Any]:
    """Run a command in a separate process and return its summary."""
    words = [sys.executable, "-m", "recon", command, str(source), "--out", str(out)]
    done = subprocess.run(
        [*words, *options, "--json", "--quiet"], capture_output=True, text=True, check=False
    )
    if done.returncode:
        sys.exit(done.stderr)
    return dict(json.loads(done.stdout))


def repeat(period: Path, drive: Path, frames: int) -> None:
    """Build a longer drive that repeats the period, by symbolic links."""
    names = sorted(path.name for path in (period / CAMERAS[0]).iterdir())
    for camera in CAMERAS:
        (drive / camera).mkdir(parents=True)
        for index in range(frames):
            picture = period / camera / names[index % len(names)]
            (drive / camera / f"{index:06d}.png").symlink_to(picture)
    write_text(drive / "calib.txt", (period / "calib.txt").read_text())
    times_s = np.arange(frames) / 10.0
    write_text(drive / "times.txt", "".join(f"{time_s:.6e}\n" for time_s in times_s))
    poses = np.tile(np.eye(4), (frames, 1, 1))
    poses[:, 2, 3] = STEP_M * np.arange(frames)
    write_kitti_poses(drive / "poses.txt", Trajectory(poses, times_s))


def ratio(one: float, other: float) -> float | None:
    """The ratio; None if the shorter drive takes no more than the libraries."""
    return round(one / other, 3) if other > 0 else None


def table(result: dict[str, Any]) -> str:
    lines = ["frames  path m   points   voxels  files MB  seconds  peak MB"]
    lines += [
        f"{row['frames']:6d}{row['path_m']:8.0f}{row['points']:9d}{row['voxels']:9d}"
        f"{row['files_mb']:10.1f}{row['seconds']:9.1f}{row['peak_mb']:9.1f}"
        for row in (result["libraries"], *result["drives"])
    ]
    lines += [f"{key}: {result[key]}" for key in result if key.startswith("longest")]
    return "\n".join(lines)


if __name__ == "__main__":
    main()
