"""Peak memory of `recon export` on a map of many drives, by its number of drives.

Each drive is 20 frames along a wall, 12 m further than the one before; nothing is rendered or
matched. The map is made by `recon.Map`, and grid and OctoMap of it on two workers; the resident
memory of each process is looked at ten times a second.

Example: python benchmarks/many_sessions.py --sessions 10 50 200 --workers 2
"""

from __future__ import annotations

import argparse
import json
import subprocess
import sys
import tempfile
import time
from collections.abc import Sequence
from contextlib import suppress
from itertools import pairwise
from pathlib import Path
from typing import Any

import checkout  # noqa: F401 - what is measured
import psutil

from recon.commands.config import load_config
from recon.core.summary import RunSummary
from recon.export.make import make
from recon.export.product import ExportContext
from recon.map.map import Map
from recon.map.sessions.joining import join_sessions
from recon.map.sessions.placed import place_map
from recon.map.store.map_file import MAP_FILE
from recon.run.run import Run
from tests.map import walls

STEP_M = 12.0
SETTINGS = ("submaps.length_m=8", "submaps.tile_m=25.6", "fusion.min_count=1")


def main(arguments: Sequence[str] | None = None) -> None:
    options = parse(arguments)
    rows = []
    with tempfile.TemporaryDirectory() as name:
        for sessions in options.sessions:
            run = build(Path(name) / str(sessions), sessions)
            rows.append({"sessions": sessions, **export(run, options.workers)})
            print(json.dumps(rows[-1]), file=sys.stderr, flush=True)
    print(json.dumps({"workers": options.workers, "rows": rows}, indent=2))


def parse(arguments: Sequence[str] | None) -> argparse.Namespace:
    parser = argparse.ArgumentParser(description=__doc__.partition("\n")[0])
    parser.add_argument("--sessions", type=int, nargs="+", default=[10, 50, 200])
    parser.add_argument("--workers", type=int, default=2)
    return parser.parse_args(arguments)


def build(folder: Path, sessions: int) -> Path:
    """Make the run of a map of that many drives, linked one to the next."""
    config = load_config(None, SETTINGS)
    true = [walls.poses(STEP_M * number) for number in range(sessions)]
    with Run("map", folder, config) as run, Map.create(run.path(MAP_FILE)) as map_:
        for number, poses in enumerate(true):
            walls.drive(map_, poses, number)
        pairs = zip(pairwise(range(sessions)), pairwise(true), strict=True)
        links = [link for ends, both in pairs for link in walls.links_between(*ends, both)]
        join_sessions(map_, links)
        map_.commit()
        context = ExportContext(map_, place_map(map_, config), config.mesh)
        make(context, run.content, ("cloud", "octomap", "grid"))
        record = {"T_map_world": map_.first.T_map_world.tolist()}
        run.finish(RunSummary(), source="wall", inputs=(), record=record)
    return folder


def export(run: Path, workers: int) -> dict[str, Any]:
    """Make grid and OctoMap; the peak of each process, the largest first."""
    words = [str(run), "--to", "grid,octomap", "--workers", str(workers), "--json", "--quiet"]
    command = [sys.executable, "-m", "recon", "export", *words, "--out", f"{run}-again"]
    begun, peaks = time.perf_counter(), dict[int, int]()
    client = subprocess.Popen(command, stdout=subprocess.PIPE)
    first = psutil.Process(client.pid)
    while client.poll() is None:
        with suppress(psutil.Error):
            for one in (first, *first.children(recursive=True)):
                peaks[one.pid] = max(peaks.get(one.pid, 0), one.memory_info().rss)
        time.sleep(0.1)
    printed, _ = client.communicate()
    if client.returncode:
        sys.exit(f"recon export ended with {client.returncode}")
    summary = json.loads(printed)
    other = sorted((peak for pid, peak in peaks.items() if pid != client.pid), reverse=True)
    return {
        "map_mb": round((run / MAP_FILE).stat().st_size / 1e6, 1),
        "voxels": summary["voxels"],
        "seconds": round(time.perf_counter() - begun, 1),
        "peak_mb": round(peaks[client.pid] / 1e6),
        "peak_mb_of_workers": [round(peak / 1e6) for peak in other[:workers]],
    }


if __name__ == "__main__":
    main()
