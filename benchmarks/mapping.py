"""Speed of mapping stage by stage, and of our ray casting against OctoMap's.

A drive is mapped as by `recon map`, mesh and report included. ``fps`` and ``frame_ms`` cover
mapping alone, from the first frame to the last; stages overlap, so they add up to more than the
time per frame. ``after_s`` covers the stages after the last frame.

For ray casting, both start from an empty map and run in turn in every round, so that other load
affects both alike; the figures are medians over the rounds. ``agreement`` is the intersection over
union of the cells that each calls occupied, or free.

Example: python benchmarks/mapping.py --json --drive DRIVE
"""

from __future__ import annotations

import argparse
import json
import os
import statistics
import tempfile
import time
from collections.abc import Callable, Sequence
from functools import partial
from pathlib import Path
from typing import Any

import checkout  # noqa: F401 - what is measured
import numpy as np
import pyoctomap
from numpy.typing import NDArray

from recon.commands.config import load_config
from recon.commands.map import run_map
from recon.commands.map_options import MapOptions
from recon.core.geometry.se3 import make_transform
from recon.core.machine import available_cores
from recon.core.values import PointCloud
from recon.core.values.arrays import Float64
from recon.map.builders import OccupancyBuilder, OccupancySettings
from recon.sources.registry import open_source

Int64 = NDArray[np.int64]
RAYS = 100_000
RANGE_M = 20.0
RESOLUTIONS_M = (0.2, 0.1)
ORIGIN_M = np.array([0.33, -0.21, 0.47])
HEIGHT_M = 1.65
HALF_WIDTH_M = 8.0
PER_FRAME = (
    *("rectify", "match", "edges", "inspect", "back_project", "filter", "thin"),
    *("odometry", "map", "store", "loops", "checkpoint"),
)
"""Stages of every frame; the first seven, odometry, mapping and the search for loops run in
separate threads."""


def main(arguments: Sequence[str] | None = None) -> None:
    options = parse(arguments)
    result = {
        "octomap": pyoctomap.__version__,
        "rays": options.rays,
        "rounds": options.rounds,
        "ray_casting": [] if options.no_rays else ray_casting(options.rays, options.rounds),
        "drive": None
        if options.no_drive or options.drive is None
        else budget(options.drive, options.set),
    }
    print(json.dumps(result, indent=2) if options.json else table(result))


def parse(arguments: Sequence[str] | None) -> argparse.Namespace:
    parser = argparse.ArgumentParser(description=__doc__.partition("\n")[0])
    parser.add_argument("--json", action="store_true", help="print JSON instead of a table")
    parser.add_argument("--rounds", type=int, default=7, help="runs that a median is taken of")
    parser.add_argument("--rays", type=int, default=RAYS, help="rays of one frame")
    parser.add_argument(
        "--drive", type=Path, default=real_drive(), help="source; RECON_DATA's kitti_raw_0013"
    )
    parser.add_argument("--no-rays", action="store_true", help="only map the drive")
    parser.add_argument("--no-drive", action="store_true", help="only cast rays")
    parser.add_argument("--set", action="append", default=[], help="a setting of recon map")
    return parser.parse_args(arguments)


def real_drive() -> Path | None:
    """The drive used for the figures in the documentation, if available."""
    folder = Path(os.environ.get("RECON_DATA", "")) / "driven" / "kitti_raw_0013"
    return folder if folder.is_dir() else None


def budget(drive: Path, overrides: Sequence[str]) -> dict[str, Any]:
    """Milliseconds per frame of each stage of a drive, and seconds of each later stage."""
    source, config = open_source(drive), load_config(None, overrides)
    with tempfile.TemporaryDirectory() as folder:
        out = Path(folder) / "run"
        before_s = time.process_time()
        summary = run_map(source, config, MapOptions(audit=False, out=out)).summary.to_json()
        stages = json.loads((out / "run.json").read_text())["timings"]
    frames, written_s = summary["frames"], stages["report"] + stages["hash"]
    return {
        "source": source.name,
        "frames": frames,
        "cores": available_cores(),
        "fps": round(summary["fps"], 2),
        "frame_ms": round(1e3 / summary["fps"], 1),
        "stages_ms": {k: round(1e3 * v / frames, 1) for k, v in stages.items() if k in PER_FRAME},
        "after_s": {k: round(v, 2) for k, v in stages.items() if k not in PER_FRAME},
        "whole_run_s": round(summary["seconds"] + written_s, 3),
        "processor_s": round(time.process_time() - before_s, 1),
        "peak_memory_mb": summary["peak_memory_mb"],
    }


def ray_casting(rays: int, rounds: int) -> list[dict[str, Any]]:
    """One row for each scene and resolution."""
    rows = []
    for name, scene in (("street", street), ("scattered", scattered)):
        for resolution_m in RESOLUTIONS_M:
            ends = to_centres(scene(rays), resolution_m)
            ms = medians_ms(
                {
                    "recon": partial(ours, ends, resolution_m),
                    "octomap": partial(octomap, ends, resolution_m),
                },
                rounds,
            )
            same = agreement(ours_cells(ends, resolution_m), octomap_cells(ends, resolution_m))
            ratio = round(ms["octomap"] / ms["recon"], 2)
            row = {"scene": name, "resolution_m": resolution_m, "ms": ms, "octomap / recon": ratio}
            rows.append({**row, "agreement": same})
    return rows


def street(rays: int) -> Float64:
    """Ray end points of a camera on a road between two walls, up to the range."""
    rng = np.random.default_rng(0)
    directions = pinhole(rng.uniform(-1, 1, rays), rng.uniform(-0.4, 0.4, rays))
    with np.errstate(divide="ignore"):
        to_road = np.where(directions[:, 1] > 0, HEIGHT_M / directions[:, 1], np.inf)
        to_wall = HALF_WIDTH_M / np.abs(directions[:, 0])
    return np.asarray(directions * np.minimum(np.minimum(to_road, to_wall), RANGE_M)[:, None])


def scattered(rays: int) -> Float64:
    """Ray end points of a camera at random ranges: nearly each in its own cell."""
    rng = np.random.default_rng(1)
    directions = pinhole(rng.uniform(-1, 1, rays), rng.uniform(-0.4, 0.4, rays))
    return np.asarray(directions * rng.uniform(2.0, RANGE_M, (rays, 1)))


def pinhole(x: Float64, y: Float64) -> Float64:
    """Unit vectors (N, 3) through points of the plane at depth 1."""
    directions = np.stack([x, y, np.ones_like(x)], axis=1)
    return np.asarray(directions / np.linalg.norm(directions, axis=1, keepdims=True))


def to_centres(xyz: Float64, resolution_m: float) -> Float64:
    """Ray end points moved to the centres of their cells, in map axes.

    OctoMap casts rays to cell centres, we cast to the mean point of a cell: now the same.
    """
    return np.asarray((np.floor((xyz + ORIGIN_M) / resolution_m) + 0.5) * resolution_m)


def ours(ends_m: Float64, resolution_m: float) -> OccupancyBuilder:
    """A map of one frame, without point uncertainty, which OctoMap does not model."""
    settings = OccupancySettings(resolution_m=resolution_m, max_range_m=RANGE_M + 1.0)
    builder = OccupancyBuilder(settings, np.eye(4))
    # Each stands for two points: a single one starts no ray.
    two = np.full(len(ends_m), 2, np.int32)
    cloud = PointCloud((ends_m - ORIGIN_M).astype(np.float32), count=two)
    builder.integrate(cloud, make_transform(np.eye(3), ORIGIN_M))
    return builder


def octomap(ends_m: Float64, resolution_m: float) -> pyoctomap.OcTree:
    """The same by OctoMap: each end cell once (discretised), inner nodes not updated (lazy)."""
    tree = pyoctomap.OcTree(resolution_m)
    tree.insertPointCloud(ends_m, ORIGIN_M, -1.0, True, True)
    return tree


def medians_ms(runs: dict[str, Callable[[], object]], rounds: int) -> dict[str, float]:
    """Median milliseconds of each; the first round compiles and is not counted."""
    seconds: dict[str, list[float]] = {name: [] for name in runs}
    for _ in range(rounds + 1):
        for name, run in runs.items():
            start = time.perf_counter()
            run()
            seconds[name].append(time.perf_counter() - start)
    return {name: round(1e3 * statistics.median(s[1:]), 2) for name, s in seconds.items()}


def ours_cells(ends_m: Float64, resolution_m: float) -> dict[str, Int64]:
    """Occupied and free cells, each packed into one number, sorted."""
    voxels = ours(ends_m, resolution_m).voxels()
    return split(voxels.keys.astype(np.int64), voxels.log_odds > 0)


def octomap_cells(ends_m: Float64, resolution_m: float) -> dict[str, Int64]:
    """The same of OctoMap."""
    leaves = [
        (*leaf.getCoordinate(), leaf.current_node.getLogOdds())
        for leaf in octomap(ends_m, resolution_m).begin_leafs()
    ]
    values = np.array(leaves)
    keys = np.floor(values[:, :3] / resolution_m).astype(np.int64)
    return split(keys, values[:, 3] > 0)


def split(keys: Int64, occupied: Any) -> dict[str, Int64]:
    """Cells (N, 3), each packed into one number, by kind."""
    packed = ((keys[:, 0] + (1 << 20)) << 42) + ((keys[:, 1] + (1 << 20)) << 21) + keys[:, 2]
    return {"occupied": np.unique(packed[occupied]), "free": np.unique(packed[~occupied])}


def agreement(one: dict[str, Int64], other: dict[str, Int64]) -> dict[str, float]:
    """Intersection over union of the cells by kind, and the number of cells of ``one``."""
    ratios: dict[str, float] = {}
    for kind, cells in one.items():
        both = len(np.intersect1d(cells, other[kind], assume_unique=True))
        either = len(cells) + len(other[kind]) - both
        ratios[kind] = round(both / either, 5)
        ratios[f"{kind}_cells"] = len(cells)
    return ratios


def table(result: dict[str, Any]) -> str:
    lines = [f"{result['rays']} rays to {RANGE_M:g} m, median ms (OctoMap {result['octomap']})"]
    for row in result["ray_casting"]:
        ms, same = row["ms"], row["agreement"]
        lines.append(
            f"  {row['scene']:10s}{row['resolution_m']:5g} m  recon {ms['recon']:8.1f}"
            f"  octomap {ms['octomap']:8.1f}  {row['octomap / recon']:6.1f}x"
            f"  same cells: occupied {same['occupied']:.4f}, free {same['free']:.4f}"
        )
    return "\n".join([*lines, *budget_table(result["drive"])])


def budget_table(drive: dict[str, Any] | None) -> list[str]:
    if drive is None:
        return ["no drive is mapped: --drive, or RECON_DATA, names one"]
    stages = ", ".join(f"{name} {ms:g}" for name, ms in drive["stages_ms"].items())
    after = ", ".join(f"{name} {s:g}" for name, s in drive["after_s"].items())
    return [
        f"{drive['source']}: {drive['frames']} frames, {drive['fps']:g} frames per second",
        f"  ms per frame ({drive['frame_ms']:g}, overlapping): {stages}",
        f"  seconds after the last frame: {after}",
    ]


if __name__ == "__main__":
    main()
