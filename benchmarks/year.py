"""A street mapped every week of a year: size, time and recall of a map that is looked after.

The drives are rendered (`tests/scenery/year.py`), 20 frames each: cars, a hoarding, a tree, leaves,
sun and rain. Each goes into one map as `recon map DRIVE --into RUN` puts it there. Beside it a map
that keeps all drives, and the newest drive alone. Products of the one that keeps all are made in
the first weeks only: later they take longer than all the rest. Before some weeks go in, their drive
is looked for in the maps of the weeks before. A frame is found if the map gives its pose and it is
within 3 cm of the truth; the truth is fitted to the paths that the map has, not to what is found.
At the end the second and the last week are put into their maps again, in turn, and timed.

Drives, runs and curves stay in --folder; drives that are there already are not rendered again.

Examples:
    python benchmarks/year.py --json
    python benchmarks/year.py --weeks 12 --folder outputs/year
"""

from __future__ import annotations

import argparse
import json
import resource
import shutil
import statistics
import subprocess
import sys
import tempfile
import time
from collections import deque
from collections.abc import Sequence
from concurrent.futures import ProcessPoolExecutor
from itertools import islice, product
from pathlib import Path
from typing import Any, Final

import checkout  # noqa: F401 - what is measured
import numpy as np
from altered_drives import write_calibration
from rich.progress import track

from recon.commands.config import run_settings
from recon.core.geometry.alignment import fit_points
from recon.core.geometry.se3 import apply
from recon.core.values.arrays import Float64
from recon.export.make import make
from recon.export.product import ExportContext
from recon.io.images.image import write_image
from recon.io.trajectory import read_tum, write_kitti_poses
from recon.map.map import Map
from recon.map.sessions.copying import copy_sessions
from recon.map.sessions.joining import join_new
from recon.map.sessions.placed import place_map
from recon.map.store.map_file import MAP_FILE
from recon.report import style
from tests.scenery.year import WEEKS, WeekDrive

NEAR_M: Final = 0.03
FRAMES: Final = 20  # of each drive
LOOKED: Final = (1, 13, 26, 39, 51)
"""Weeks, from 0, whose drive is looked for in the weeks before, and at which maps are compared."""
ROUNDS: Final = 3  # of which the median counts
PRODUCED: Final = 2  # of these maps, products are made of the first ones that keep all drives
KEPT: Final = {"looked after": "into", "all kept": "all", "newest only": "newest"}
JOINING: Final = ("links", "forget", "map", "cloud", "octomap", "grid")
"""What takes longer in a larger map, by its names in the summary."""
PRODUCTS: Final = ("cloud", "octomap", "grid")


def main(arguments: Sequence[str] | None = None) -> None:
    options = parse(arguments)
    with tempfile.TemporaryDirectory() as name:
        folder = Path(name) if options.folder is None else options.folder
        begun = time.perf_counter()
        names = [name for name in KEPT if name != "all kept" or not options.quick]
        year = Year(folder, names, options.weeks)
        with ProcessPoolExecutor(1) as renderer:
            # That of the next week is rendered beside each week's mapping.
            drives = deque([renderer.submit(write_drive, 0, year.drive_of(0))])
            for week in track(range(options.weeks), "weeks", disable=options.json):
                if week + 1 < options.weeks:
                    drives.append(renderer.submit(write_drive, week + 1, year.drive_of(week + 1)))
                year.add(week, drives.popleft().result())
                (folder / "year.json").write_text(json.dumps(year.rows, indent=2))
        year.time_again()
        found = {"maps": year.rows, "minutes": (time.perf_counter() - begun) / 60.0}
        (folder / "year.png").write_bytes(curves(year.rows))
    if options.json:
        print(json.dumps(found, indent=2))
    else:
        print(table(year.rows))


def parse(arguments: Sequence[str] | None) -> argparse.Namespace:
    parser = argparse.ArgumentParser(description=__doc__.partition("\n")[0])
    parser.add_argument("--weeks", type=int, default=WEEKS, help="how many, from the first")
    parser.add_argument("--quick", action="store_true", help="without a map that keeps all")
    parser.add_argument("--folder", type=Path, help="where all stays; default: nowhere")
    parser.add_argument("--json", action="store_true", help="print JSON instead of a table")
    return parser.parse_args(arguments)


class Year:
    """The maps of a year in a folder; ``rows`` are what was measured, by map and week."""

    def __init__(self, folder: Path, names: Sequence[str], weeks: int) -> None:
        self.folder, self.timed = folder, sorted({1, weeks - 1} & {*range(1, weeks)})
        for name in (*KEPT.values(), "found", "products", "before", "again"):
            shutil.rmtree(folder / name, ignore_errors=True)
        self.files = {name: folder / each / MAP_FILE for name, each in KEPT.items()}
        for file in self.files.values():
            file.parent.mkdir(parents=True) if "into" not in file.parts else None
        self.rows: dict[str, dict[int, dict[str, float]]] = {name: {} for name in names}

    def drive_of(self, week: int) -> Path:
        return self.folder / "drives" / f"{week:02d}"

    def add(self, week: int, drive: Path) -> None:
        """Look for the drive of a week in the maps so far, then put it into them."""
        for name in self.rows if week in LOOKED else ():
            self._row(name, week - 1).update(self._found(drive, self.files[name], name))
        into = self.folder / KEPT["looked after"]
        if week in self.timed:
            shutil.copytree(into, self.folder / "before" / drive.name)
        seconds, summary = run("map", drive, "--no-mesh", "--into" if week else "--out", into)
        self._row("looked after", week).update(seconds=seconds, megabytes=size(into / MAP_FILE))
        joined = sum(summary["stages"].get(name, 0.0) for name in JOINING) / summary["seconds"]
        with Map.open(into) as map_:
            before = [one.number for one in map_.sessions[:-1]]
            file = self.files["newest only"]
            with Map.create(file) as alone:
                copy_sessions(map_, alone, before)
                alone.commit()
            self._row("newest only", week)["megabytes"] = size(file)
            if "all kept" in self.rows:
                self._keep_all(map_, before, seconds * (1 - joined), week)

    def time_again(self) -> None:
        """Time the second and the last week again, in turn: the machine may not be as it was."""
        seconds: dict[int, list[float]] = {week: [] for week in self.timed}
        again = self.folder / "again"
        for _, week in product(range(ROUNDS), self.timed):
            drive = self.drive_of(week)
            shutil.copytree(self.folder / "before" / drive.name, again)
            seconds[week].append(run("map", drive, "--no-mesh", "--into", again)[0])
            shutil.rmtree(again)
        for week, found in seconds.items():
            self._row("looked after", week)["seconds"] = statistics.median(found)

    def _row(self, name: str, week: int) -> dict[str, float]:
        return self.rows[name].setdefault(week, {})

    def _keep_all(self, newest: Map, before: list[int], mapped_s: float, week: int) -> None:
        """Merge a drive; its products are made where maps are compared, and do not take long."""
        file, row, begun = self.files["all kept"], self._row("all kept", week), time.process_time()
        with Map.open(file, read_only=False) if week else Map.create(file) as map_:
            join_new(map_, copy_sessions(newest, map_, before))
            map_.commit()
            if week + 1 in LOOKED[:PRODUCED]:
                config = run_settings(self.folder / KEPT["looked after"])
                placed = place_map(map_, config, 2)
                out = self.folder / "products"
                out.mkdir(exist_ok=True)
                make(ExportContext(map_, placed, config.mesh, threads=2), out, PRODUCTS)
                row["seconds"] = mapped_s + time.process_time() - begun
        row["megabytes"] = size(file)  # of a closed one, whose changes are all in it

    def _found(self, drive: Path, map_: Path, name: str) -> dict[str, float]:
        """Look for a drive in a map; what part of its frames is found, and how precisely."""
        out = self.folder / "found" / f"{KEPT[name]}-{drive.name}"
        run("localize", drive, "--map", map_, "--out", out)
        true = true_path(drive)
        # The truth where the map has it: by the paths of its drives.
        with Map.open(map_) as known:
            ours, theirs = [], []
            for number, path in known.paths.items():
                source = known.session(number).info.source
                theirs.append(true_path(drive.parent / source)[:, :3, 3])
                ours.append(path.positions_m)
        T_map_street = fit_points(np.concatenate(theirs), np.concatenate(ours)).T_to_from
        path = read_tum(out / "trajectory_tum.txt")
        stamps_s = np.loadtxt(drive / "times.txt")
        frames = np.abs(stamps_s[:, None] - path.timestamps_s).argmin(axis=0)
        off_m = np.linalg.norm(path.positions_m - apply(T_map_street, true[frames, :3, 3]), axis=1)
        return {
            "found_percent": 100.0 * float((off_m <= NEAR_M).sum()) / len(true),
            "off_m": float(np.median(off_m)),
            "far_m": float(off_m.max()),
        }


def write_drive(week: int, folder: Path) -> Path:
    """Write the drive of a week in the layout of KITTI's odometry benchmark, with its dates."""
    if folder.exists():
        return folder
    drive, part = WeekDrive(week), folder.with_suffix(".part")
    for side in ("image_0", "image_1"):
        (part / side).mkdir(parents=True, exist_ok=True)
    for pair in islice(drive.frames(), FRAMES):
        for side, image in (("image_0", pair.left), ("image_1", pair.right)):
            write_image(part / side / f"{pair.index:06d}.png", image)
    write_calibration(drive.calibration, part / "calib.txt")
    path = drive.trajectory.select(np.arange(FRAMES))
    np.savetxt(part / "times.txt", path.timestamps_s, fmt="%.6f")
    write_kitti_poses(part / "poses.txt", path)
    np.save(part / "T_street_first.npy", drive.world.T_street_camera[0])
    return part.rename(folder)


def true_path(drive: Path) -> Float64:
    """The true poses of a drive (N, 4, 4), in the axes of the street."""
    rows = np.loadtxt(drive / "poses.txt").reshape(-1, 3, 4)
    poses = np.tile(np.eye(4), (len(rows), 1, 1))
    poses[:, :3] = rows
    return np.asarray(np.load(drive / "T_street_first.npy") @ poses)


def run(command: str, *words: object) -> tuple[float, dict[str, Any]]:
    """Run a command; return the processor seconds that it took, and its summary."""
    line = [sys.executable, "-m", "recon", command, *map(str, words), "--json", "--quiet"]
    begun_s = spent_s()
    done = subprocess.run(line, capture_output=True, text=True, check=False)
    if done.returncode:
        sys.exit(f"recon {command} ended with {done.returncode}: {done.stderr.strip()}")
    return spent_s() - begun_s, json.loads(done.stdout)


def spent_s() -> float:
    """Processor seconds of all commands so far, which other programs change little."""
    used = resource.getrusage(resource.RUSAGE_CHILDREN)
    return used.ru_utime + used.ru_stime


def size(file: Path) -> float:
    return file.stat().st_size / 1e6


@style.styled
def curves(rows: dict[str, dict[int, dict[str, float]]]) -> bytes:
    """Size, time and recall over the weeks."""
    shown = {
        "megabytes": "map, MB",
        "seconds": "processor seconds to add a drive",
        "found_percent": "% of the next drive found at 3 cm",
    }
    figure, panels = style.subplots(style.WIDE_IN, 3.4, 1, len(shown), squeeze=False)
    for panel, (key, label) in zip(panels[0], shown.items(), strict=True):
        for name, weeks in rows.items():
            known = [(week + 1, row[key]) for week, row in weeks.items() if key in row]
            line = "o-" if len(known) < len(weeks) else "-"
            panel.plot(*np.transpose(known).reshape(2, -1), line, label=name, markersize=3)
        top = 103.0 if key == "found_percent" else None
        panel.set(xlabel="week", ylabel=label, ylim=(0.0, top))
    panels[0][0].legend()
    return style.to_png(figure)


def table(rows: dict[str, dict[int, dict[str, float]]]) -> str:
    keys = ("megabytes", "seconds", "found_percent", "off_m", "far_m")
    lines = [f"{'map':<14} {'week':>4} " + " ".join(f"{key:>13}" for key in keys)]
    for name, weeks in rows.items():
        for week, row in weeks.items():
            cells = (f"{row[key]:>13.3f}" if key in row else f"{'':>13}" for key in keys)
            lines.append(f"{name:<14} {week + 1:>4} " + " ".join(cells))
    return "\n".join(lines)


if __name__ == "__main__":
    main()
