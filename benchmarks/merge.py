"""Several drives in one map: a drive in two halves, a second drive on another day, and look-alikes.

- `halves`: a real drive cut into two that overlap, mapped apart and merged, beside one run of it.
- `second`: a rendered street driven twice, with another light, other parked cars and 2 m aside, or
  (`--lane opposite`) back on the other side: the merged map and each of the two against the surface
  that the second drive would have found, and how many of its frames find themselves in the first.
- `alike`: keyframes of streets that look alike but are elsewhere: links that should not be.

Example: python benchmarks/merge.py --json
"""

from __future__ import annotations

import argparse
import json
import os
import tempfile
import time
from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any
from unittest.mock import patch

import checkout  # noqa: F401 - what is measured
import numpy as np

from recon.commands.config import ReconConfig, load_config
from recon.commands.localize import run_localize
from recon.commands.map import run_map
from recon.commands.map_options import MapOptions
from recon.commands.merge import run_merge
from recon.core.geometry import se3
from recon.core.values import FREE, OCCUPIED, UNKNOWN, OccupancyGrid, PointCloud, Trajectory
from recon.core.values.arrays import Bool, Float32, Float64
from recon.evaluation.map import evaluate_map
from recon.evaluation.trajectory import evaluate_trajectory
from recon.io.models.ply import read_ply
from recon.io.models.rasters import read_grid
from recon.io.trajectory import read_trajectory
from recon.map.map import Map
from recon.map.sessions.joining import find_links
from recon.map.sessions.measured import Survey
from recon.map.store.session import SessionInfo
from recon.odometry.protocol import OdometryHealth
from recon.places.detector import StoredKeyframe
from recon.places.keyframe import make_keyframe
from recon.places.places import path_lengths
from recon.sources.synthetic import SyntheticSource
from recon.stereo.frame import FrameReconstructor
from recon.street.path import LANE_M
from recon.street.settings import StreetScene
from recon.street.street import StreetWorld, build_street

THRESHOLD_M = 0.2
LATERAL_M = {"aside": LANE_M + 2.0, "opposite": -LANE_M}
"""Of the second drive, to the left of the centre line."""
TURNED = np.diag([-1.0, 1.0, -1.0, 1.0])
"""From the camera that looks back to the one that looks ahead."""


def main(arguments: Sequence[str] | None = None) -> None:
    options = parse(arguments)
    result: dict[str, Any] = {}
    with tempfile.TemporaryDirectory() as folder:
        if "halves" in options.parts and options.drive is not None:
            result["halves"] = halves(options.drive, options.overlap, Path(folder))
        if "second" in options.parts:
            result["second"] = second(options, Path(folder))
    if "alike" in options.parts:
        result["alike"] = alike(options.tries, options.width)
    print(json.dumps(result, indent=2))


def parse(arguments: Sequence[str] | None) -> argparse.Namespace:
    parser = argparse.ArgumentParser(description=__doc__.partition("\n")[0])
    parser.add_argument("--json", action="store_true", help="JSON, which is printed anyway")
    parser.add_argument("--parts", nargs="+", default=["halves", "second", "alike"])
    parser.add_argument("--drive", type=Path, default=real_drive(), help="source of the halves")
    parser.add_argument("--overlap", type=int, default=25, help="frames that both halves have")
    parser.add_argument("--seed", type=int, default=3, help="another seed is another street")
    parser.add_argument("--frames", type=int, default=40, help="frames of each rendered drive")
    parser.add_argument("--width", type=int, default=480, help="width of the rendered pictures")
    parser.add_argument("--lane", choices=LATERAL_M, default="aside", help="of the second drive")
    parser.add_argument(
        "--measured",
        type=float,
        metavar="SIGMA_M",
        help="hold both rendered drives at their true positions with noise, as of an antenna",
    )
    parser.add_argument("--tries", type=int, default=200, help="pairs of streets that look alike")
    return parser.parse_args(arguments)


def real_drive() -> Path | None:
    """The drive used for the figures in the documentation, if available."""
    folder = Path(os.environ.get("RECON_DATA", "")) / "driven" / "kitti_raw_0013"
    return folder if folder.is_dir() else None


def halves(drive: Path, overlap: int, folder: Path) -> dict[str, Any]:
    """A drive in one run, and in two that are merged."""
    frames = len(MapOptions(source=drive).open(load_config())[0])
    middle = (frames + overlap) // 2
    spans = {"whole": (0, frames), "first": (0, middle), "second": (middle - overlap, frames)}
    for name, (start, end) in spans.items():
        config = load_config(None, [f"source.start={start}", f"source.end={end}"])
        source, options = MapOptions(source=drive, mesh=False).open(config)
        run_map(source, config, replace(options, out=folder / name, audit=False))
    began = time.perf_counter()
    options = MapOptions("merge", folder / "merged", mesh=False)
    summary = run_merge([folder / "first", folder / "second"], None, options).to_json()
    seconds = time.perf_counter() - began
    truth = MapOptions(source=drive).open(load_config())[0].truth
    found = compare_halves(folder, middle, None if truth is None else truth.trajectory)
    return {**found, "links": summary["links"], "seconds": round(seconds, 1)}


def compare_halves(folder: Path, middle: int, truth: Trajectory | None) -> dict[str, Any]:
    """Path and grid of a merged run beside those of one run."""
    whole = read_trajectory(folder / "whole/trajectory_tum.txt")
    parts = [read_trajectory(folder / f"merged/sessions/{n}/trajectory_tum.txt") for n in (0, 1)]
    behind = len(parts[0]) + len(parts[1]) - len(whole)
    poses = [parts[0].T_world_camera, parts[1].T_world_camera[behind:]]
    merged = Trajectory(np.concatenate(poses), whole.timestamps_s)
    apart_m = np.linalg.norm(merged.positions_m - whole.positions_m, axis=1)
    grids = [read_grid(folder / name / "map/grid.yaml") for name in ("whole", "merged")]
    return {
        "frames": [len(whole), *map(len, parts)],
        "path_apart_m": round(float(apart_m.max()), 3),
        "t_rel_percent": {
            name: round(evaluate_trajectory(path, truth).t_rel_percent, 4)
            for name, path in (("one run", whole), ("merged", merged))
            if truth is not None
        },
        "grid": differing_cells(*grids),
    }


def differing_cells(one: OccupancyGrid, other: OccupancyGrid) -> dict[str, float]:
    """Fractions of the cells known to either that differ, by what the two say."""
    ours, theirs = overlaid(one, other)
    known = (ours != UNKNOWN) | (theirs != UNKNOWN)
    opposite = ((ours == FREE) & (theirs == OCCUPIED)) | ((ours == OCCUPIED) & (theirs == FREE))
    return {
        "known_cells": int(known.sum()),
        "differ": round(float((ours != theirs)[known].mean()), 5),
        "free_against_occupied": round(float(opposite[known].mean()), 5),
    }


def overlaid(one: OccupancyGrid, other: OccupancyGrid) -> tuple[np.ndarray, np.ndarray]:
    """The cells of two grids of one map on a common raster."""
    corners = [np.rint(np.array(g.origin_m) / g.resolution_m).astype(int) for g in (one, other)]
    ends = [c + g.cells.shape[::-1] for c, g in zip(corners, (one, other), strict=True)]
    low, high = np.minimum(*corners), np.maximum(*ends)
    found = []
    for corner, grid in zip(corners, (one, other), strict=True):
        cells = np.full((high - low)[::-1], UNKNOWN, np.int8)
        (x, y), (rows, columns) = corner - low, grid.cells.shape
        cells[y : y + rows, x : x + columns] = grid.cells
        found.append(cells)
    return found[0], found[1]


def second(asked: argparse.Namespace, folder: Path) -> dict[str, Any]:
    """A street on two days, and the map of both."""
    config = load_config(None, [])
    days = [street_on(lane, asked) for lane in (None, asked.lane)]
    for number, source in enumerate(days):
        options = MapOptions(out=folder / f"day{number}", mesh=False, audit=False)
        run_map(source, config, options)
    runs = [folder / "day0", folder / "day1"]
    if asked.measured is not None:
        runs = [hold(*each, asked.measured) for each in zip(runs, days, strict=True)]
    merged = run_merge(runs, None, MapOptions("merge", folder / "days", mesh=False))
    summary = merged.to_json()
    options = MapOptions("localize", folder / "found")
    found = run_localize(days[1], folder / "day0", config, options).summary.to_json()
    return {
        "links": summary["links"],
        "warnings": summary["warnings"],
        "localized": {name: found[name] for name in ("frames", "frames_tracking", "warnings")},
        **compare_days(days, folder, config),
    }


def hold(run: Path, source: SyntheticSource, sigma_m: float) -> Path:
    """A run held at its true positions in the street, with noise."""
    places_m = source.world.T_street_camera[:, :3, 3]
    noise_m = np.random.default_rng(1).normal(0.0, sigma_m, places_m.shape)
    file, out = run.with_suffix(".txt"), run.with_name(f"held_{run.name}")
    np.savetxt(file, np.column_stack([source.trajectory.timestamps_s, places_m + noise_m]))
    run_merge([run], None, MapOptions("merge", out, mesh=False), Survey(file))
    return out


def compare_days(
    days: Sequence[SyntheticSource], folder: Path, config: ReconConfig
) -> dict[str, Any]:
    """The maps of the days against what stood in the street on the second one."""
    T_first_second = se3.invert(days[0].world.T_street_camera[0]) @ days[1].world.T_street_camera[0]
    truth = true_street(days, T_first_second)
    left = left_cars(days)
    clouds = {
        "first": cloud_in_world(folder / "day0"),
        "second": moved(cloud_in_world(folder / "day1"), T_first_second),
        "merged": cloud_in_world(folder / "days"),
    }
    rows = {}
    for name, cloud in clouds.items():
        gone = near(cloud, left, THRESHOLD_M)
        judged = cloud if name != "first" else PointCloud(cloud.xyz[~gone], frame="world")
        metrics = evaluate_map(judged, truth, THRESHOLD_M)
        rows[name] = {
            "points": len(cloud),
            "precision": round(metrics.precision, 4),
            "recall": round(metrics.recall, 4),
            "f_score": round(metrics.f_score, 4),
            "points_of_cars_that_left": int(gone.sum()),
        }
    return {"voxel_m": config.fusion.voxel_m, "clouds": rows}


def street_on(lane: str | None, asked: argparse.Namespace) -> SyntheticSource:
    """The street on the first day (None), or on the second one in a lane."""
    settings = StreetScene(
        seed=asked.seed,
        frames=asked.frames,
        width_px=asked.width,
        height_px=asked.width * 3 // 8,
        focal_px=asked.width * 0.5625,
        smooth_edges=False,
    )
    source = SyntheticSource(settings)
    world = build_street(settings) if lane is None else world_on_second_day(lane, settings)
    source.__dict__["world"] = world  # in place of the cached one
    return source


def world_on_second_day(lane: str, settings: StreetScene) -> StreetWorld:
    """The street with other parked cars and the sun elsewhere, driven in some lane."""
    from recon.street import street  # noqa: PLC0415 - patched here

    own = street._parked_cars

    def parked(road: Any, side: float, rng: np.random.Generator) -> Any:
        return own(road, side, np.random.default_rng([settings.seed, 77, 1]))

    with (
        patch.object(street, "_parked_cars", parked),
        patch("recon.street.path.LANE_M", LATERAL_M[lane]),
    ):
        world = build_street(settings)
    world = replace(world, to_sun=world.to_sun * [-1.0, 1.0, 1.0])
    if lane == "opposite":
        world = replace(world, T_street_camera=world.T_street_camera[::-1] @ TURNED)
    return world


def true_street(days: Sequence[SyntheticSource], T_first_second: Float64) -> PointCloud:
    """What both days saw of what stands on the second one, in the world of the first."""
    second_m = se3.apply(T_first_second, seen_of(days[1]).astype(np.float64))
    first_m = seen_of(days[0])
    left = near(PointCloud(first_m, frame="world"), left_cars(days), 0.1)
    xyz = np.concatenate([second_m, first_m[~left]]).astype(np.float32)
    return PointCloud(xyz, frame="world")


def seen_of(day: SyntheticSource) -> Float32:
    """Points on all surfaces that a drive saw."""
    surface = day.truth.surface
    if surface is None:
        raise SystemExit("a rendered street has a surface")
    return surface.xyz


def left_cars(days: Sequence[SyntheticSource]) -> Float64:
    """Points on the surfaces that the first drive saw and that are gone on the second day."""
    seen = seen_of(days[0]).astype(np.float64)
    soups = [corners_of(day.world) for day in days]
    gone = np.setdiff1d(soups[0], soups[1])
    T = days[0].world.T_world_street
    vertices = days[0].world.soup.vertices.reshape(-1, 9)
    rows = np.flatnonzero(np.isin(corners_of(days[0].world), gone))
    corners = se3.apply(T, vertices[rows].reshape(-1, 3).astype(np.float64))
    there = seen[near(PointCloud(seen.astype(np.float32), frame="world"), corners, 0.35)]
    # Where something stands on the second day, points are of that.
    T_first_second = T @ days[1].world.T_street_camera[0]
    later = se3.apply(T_first_second, seen_of(days[1]).astype(np.float64))
    return there[~near(PointCloud(there.astype(np.float32), frame="world"), later, 0.35)]


def corners_of(world: StreetWorld) -> np.ndarray:
    """One number for each triangle of a street."""
    rounded = np.ascontiguousarray(np.round(world.soup.vertices.reshape(-1, 9), 5))
    return np.array([hash(row.tobytes()) for row in rounded])


def near(cloud: PointCloud, points_m: Float64, within_m: float) -> Bool:
    """Which points of a cloud are near some others."""
    import open3d as o3d  # noqa: PLC0415 - slow, and only here

    if not len(points_m) or not len(cloud):
        return np.zeros(len(cloud), np.bool_)
    one, other = (o3d.geometry.PointCloud() for _ in range(2))
    one.points = o3d.utility.Vector3dVector(cloud.xyz.astype(np.float64))
    other.points = o3d.utility.Vector3dVector(np.array(points_m, np.float64))
    return np.asarray(one.compute_point_cloud_distance(other)) <= within_m


def cloud_in_world(run: Path) -> PointCloud:
    """The cloud of a run in the world of its first camera."""
    T_map_world = np.array(json.loads((run / "run.json").read_text())["T_map_world"])
    return moved(read_ply(run / "map/cloud.ply"), se3.invert(T_map_world))


def moved(cloud: PointCloud, T: Float64) -> PointCloud:
    """The points of a cloud after a motion."""
    xyz = se3.apply(T, cloud.xyz.astype(np.float64)).astype(np.float32)
    return PointCloud(xyz, frame="world")


def alike(tries: int, width: int) -> dict[str, Any]:
    """Links between streets of the same builder, and within one that repeats itself."""
    drives = [keyframes(seed, width) for seed in range(int(np.ceil((2 * tries) ** 0.5)) + 1)]
    pairs = [(a, b) for a in range(len(drives)) for b in range(a)][:tries]
    wrong = sum(bool(links_between(drives[a], drives[b])) for a, b in pairs)
    # The first drive sees each place of the repeated street more than once.
    repeated = [keyframes(seed, width, repeat_m=30.0, frames=58) for seed in range(5)]
    ambiguous = sum(bool(links_between(d[:44], d[44:])) for d in repeated)
    return {"tries": len(pairs), "wrong": wrong, "repeated": len(repeated), "linked": ambiguous}


def keyframes(
    seed: int, width: int, repeat_m: float | None = None, frames: int = 16
) -> list[tuple[StoredKeyframe, Any]]:
    """The keyframes of a short drive with its true poses, and the camera."""
    path = "curve" if repeat_m is None else "straight"
    scene = StreetScene(
        seed=seed, frames=frames, path=path, repeat_m=repeat_m, speed_m_per_frame=1.5,
        width_px=width, height_px=width * 3 // 8, focal_px=width * 0.5625, smooth_edges=False,
    )  # fmt: skip
    source = SyntheticSource(scene)
    reconstruct = FrameReconstructor(source.calibration, load_config())
    poses = source.trajectory.T_world_camera
    path_m = path_lengths(poses, np.ones(len(poses), bool))
    found = []
    for number, pair in enumerate(source.frames()):
        keyframe = make_keyframe(number, *reconstruct.match(pair))
        found.append((StoredKeyframe(keyframe, poses[number], float(path_m[number])), source))
    return found


def links_between(one: Sequence[Any], other: Sequence[Any]) -> int:
    """Number of links that are found between two drives."""
    with Map.temporary() as map_:
        for drive in (one, other):
            session = map_.begin(SessionInfo())
            session.set_axes(np.eye(4), drive[0][1].calibration)
            for number, (stored, _) in enumerate(drive):
                session.add_frame(stored.T_world_camera, float(number), OdometryHealth())
                again = replace(stored.keyframe, frame=number)
                session.keyframes.put(replace(stored, keyframe=again))
        return len(find_links(map_, [1]))


if __name__ == "__main__":
    main()
