"""How much of what a rendered drive shows its map has, by depth, and how much of the map is right.

The drive has true disparities in `truth/` (PNG, times 256) and a true path. A true point counts at
the least depth at which a frame sees it; points of both are right, or found, within 10 cm: what 0.3
px are at 5 m with a focal length of 320 px and a baseline of 0.25 m.

Example: python benchmarks/surfaces.py $RECON_DATA/rendered/yard --set scene.scale=0.5 --json
"""

from __future__ import annotations

import argparse
import json
import sys
from collections.abc import Iterator, Sequence
from itertools import pairwise
from pathlib import Path
from typing import Any

import checkout  # noqa: F401 - what is measured
import cv2
import numpy as np
from scipy.spatial import cKDTree

from recon.commands.config import load_config
from recon.core.geometry.se3 import apply, invert
from recon.core.kernels.voxels import pack_keys
from recon.core.values import RectifiedCamera
from recon.look.look import look_at
from recon.map.drive.scale import measure_scene
from recon.map.drive.sequence import MappedSequence, map_sequence
from recon.map.fusion import fusion_range_m
from recon.sources.registry import open_source
from recon.sources.source import StereoSource

NEAR_M = 0.1
BANDS_M = (0.0, 2.0, 4.0, 6.0, 10.0)
GRAIN_M = 0.02  # in which true points count once


def main(arguments: Sequence[str] | None = None) -> None:
    options = parse(arguments)
    source = open_source(options.drive)
    mapped = mapped_of(source, options.set)
    found = {**reach_of(mapped), **compared(Path(options.drive), source, mapped)}
    print(json.dumps(found) if options.json else "\n".join(f"{k}: {v}" for k, v in found.items()))


def parse(arguments: Sequence[str] | None) -> argparse.Namespace:
    parser = argparse.ArgumentParser(description=__doc__.partition("\n")[0])
    parser.add_argument("drive", help="folder with left/, right/, truth/ and groundtruth.txt")
    parser.add_argument("--set", action="append", default=[], help="a setting, as scene.scale=0.5")
    parser.add_argument("--json", action="store_true")
    return parser.parse_args(arguments)


def mapped_of(source: StereoSource, changes: Sequence[str]) -> MappedSequence:
    """Map the drive as `recon map` does."""
    config = load_config(None, changes)
    look = look_at(source, config, config.rig)
    scene = measure_scene(look.recorded, look.rig.calibration, config)
    return map_sequence(look.rig.applied(look.source), config.at_scale(scene.scale))


def reach_of(mapped: MappedSequence) -> dict[str, Any]:
    fusion = mapped.config.fusion
    return {
        "scale": mapped.config.scale,
        "voxel_m": fusion.voxel_m,
        "largest_voxel_m": fusion.largest_voxel_m,
        "reach_m": round(fusion_range_m(mapped.camera, fusion), 2),
        "points": len(mapped.cloud),
    }


def compared(folder: Path, source: StereoSource, mapped: MappedSequence) -> dict[str, Any]:
    """Percent of the true points found, and of the map's right, in all and by depth."""
    known = None if source.truth is None else source.truth.trajectory
    if known is None:
        sys.exit(f"{folder} has no true path")
    truth = known.T_world_camera
    poses = [invert(truth[0]) @ T for T in truth]
    true_m, depth_m = true_points(folder, mapped.camera, poses)
    ours_m = mapped.cloud.xyz.astype(np.float64)
    ours_depth_m = least_depths(ours_m, mapped.camera, poses)
    right = cKDTree(true_m).query(ours_m)[0] < NEAR_M
    seen = cKDTree(ours_m).query(true_m)[0] < NEAR_M
    found: dict[str, Any] = {"precision": percent(right)}
    for low, high in pairwise(BANDS_M):
        for name, hit, at_m in (("recall", seen, depth_m), ("precision", right, ours_depth_m)):
            found[f"{name} {low:g} to {high:g} m"] = percent(hit[(at_m >= low) & (at_m < high)])
    return found


def percent(hit: np.ndarray) -> float | None:
    return round(100.0 * float(hit.mean()), 1) if len(hit) > 1000 else None


def true_points(
    folder: Path, camera: RectifiedCamera, poses: Sequence[np.ndarray]
) -> tuple[np.ndarray, np.ndarray]:
    """True points (N, 3) in the axes of the first camera, and their least depth in a frame."""
    points_m, depths_m = (
        np.concatenate(each) for each in zip(*frames(folder, camera, poses), strict=True)
    )
    order = np.argsort(depths_m, kind="stable")
    cells = pack_keys(np.floor(points_m[order] / GRAIN_M).astype(np.int64))
    first = order[np.unique(cells, return_index=True)[1]]
    return points_m[first], depths_m[first]


def frames(
    folder: Path, camera: RectifiedCamera, poses: Sequence[np.ndarray]
) -> Iterator[tuple[np.ndarray, np.ndarray]]:
    for path, T in zip(sorted((folder / "truth").glob("*.png")), poses, strict=True):
        image: Any = cv2.imread(str(path), cv2.IMREAD_UNCHANGED)
        disparity_px = image / 256.0
        v, u = np.nonzero(disparity_px > 0.1)
        z = camera.focal_px * camera.baseline_m / disparity_px[v, u]
        x, y = (u - camera.cx_px) / camera.focal_px, (v - camera.cy_px) / camera.focal_px
        near = z < 2.0 * BANDS_M[-1]
        yield apply(T, (np.stack([x, y, np.ones_like(x)], axis=1) * z[:, None])[near]), z[near]


def least_depths(
    xyz_m: np.ndarray, camera: RectifiedCamera, poses: Sequence[np.ndarray]
) -> np.ndarray:
    """Least depth (N,) at which a frame can see each point; infinite = in no image."""
    least_m = np.full(len(xyz_m), np.inf)
    half = np.array([camera.cx_px, camera.cy_px]) / camera.focal_px
    for T in poses:
        own_m = apply(invert(T), xyz_m)
        inside = (np.abs(own_m[:, :2]) <= half * own_m[:, 2:]).all(axis=1)
        least_m[inside] = np.minimum(least_m, own_m[:, 2])[inside]
    return least_m


if __name__ == "__main__":
    main()
