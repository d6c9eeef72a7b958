"""Signed distances of a rendered street (`recon export --to esdf`) against its exact surfaces.

In seen free space within ``--near`` metres of the path, where the true distance is less than where
ours end: how far ours is off, how often it says more than a voxel more than is true (what was not
seen), and the seconds and the memory that the product takes.

Example: python benchmarks/esdf.py --seed 0 --json
"""

from __future__ import annotations

import argparse
import json
import time
import tracemalloc
from collections.abc import Sequence
from typing import Any

import checkout  # noqa: F401 - what is measured
import numpy as np
from scipy.spatial import cKDTree

from recon.commands.config import load_config
from recon.core.geometry.se3 import apply
from recon.map.drive.sequence import map_sequence
from recon.map.esdf import DistanceField
from recon.sources.synthetic import SyntheticSource
from recon.street.settings import StreetScene
from recon.street.truth import true_surface

_SURFACE_M = 0.05


def main(arguments: Sequence[str] | None = None) -> None:
    parser = argparse.ArgumentParser(description=__doc__.partition("\n")[0])
    parser.add_argument("--seed", type=int, default=0, help="of the street")
    parser.add_argument("--frames", type=int, default=40)
    parser.add_argument("--near", type=float, default=8.0, help="distance from the path, metres")
    parser.add_argument("--json", action="store_true", help="print JSON")
    options = parser.parse_args(arguments)
    found = figures(options.seed, options.frames, options.near)
    lines = (f"{name:24s} {value}" for name, value in found.items())
    print(json.dumps(found) if options.json else "\n".join(lines))


def figures(seed: int, frames: int, near_m: float) -> dict[str, Any]:
    source = SyntheticSource(StreetScene(seed=seed, frames=frames))
    mapped = map_sequence(source, load_config(), known_poses=source.trajectory)
    truth = true_surface(source.camera, voxel_m=_SURFACE_M)
    surface = cKDTree(apply(mapped.T_map_world, truth.xyz))
    path = cKDTree(apply(mapped.T_map_world, mapped.trajectory.positions_m))
    field, resolution_m = DistanceField(mapped.tiles), mapped.tiles.resolution_m
    tracemalloc.start()
    start_s = time.perf_counter()
    parts = [field.of_tile(tile.key) for tile in mapped.tiles]
    seconds, peak_mb = time.perf_counter() - start_s, tracemalloc.get_traced_memory()[1] / 1e6
    tracemalloc.stop()
    cells, ours = (np.concatenate(each) for each in zip(*parts, strict=True))
    at = (cells + 0.5) * resolution_m
    chosen = (ours > 0) & (path.query(at)[0] <= near_m)
    true = surface.query(at[chosen])[0]
    known = true < field.max_distance_m
    off = ours[chosen][known] - true[known]
    return {
        "places": int(known.sum()),
        "off": float(np.median(np.abs(off))),
        "off, 95 %": float(np.quantile(np.abs(off), 0.95)),
        "nearer": float(np.median(-off)),
        "too far": float(100 * np.mean(off > resolution_m)),
        "seconds": seconds,
        "memory": peak_mb,
    }


if __name__ == "__main__":
    main()
