"""Benefit of loop closure: a drive around a block with and without it, and perceptual aliasing.

- `block`: the drive with its own odometry. End-point error before and after loop closure, and the
  fused cloud and occupied grid cells against the true surface.
- `drift`: the same with drift added to the odometry.
- `alike`: a straight street that repeats itself, where every loop would be false.

Example: python benchmarks/loops.py --json
"""

from __future__ import annotations

import argparse
import json
import time
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from pathlib import Path
from typing import Any
from unittest.mock import patch

import checkout  # noqa: F401 - what is measured
import numpy as np

from recon.commands.config import ReconConfig, load_config
from recon.core.geometry import se3
from recon.core.geometry.alignment import fit_points
from recon.core.geometry.se3 import transform_cloud
from recon.core.values import OCCUPIED, OccupancyGrid, PointCloud, StereoPair, Trajectory
from recon.core.values.arrays import Float64
from recon.evaluation.map import evaluate_map
from recon.map.drive.drive import Workspace
from recon.map.drive.sequence import MappedSequence, map_sequence
from recon.map.fusion import fusion_range_m
from recon.map.ground.grid import flatten
from recon.map.ground.surface import add_floors, estimate_ground_surface, find_floors
from recon.map.store.session import NO_LOOPS
from recon.odometry.protocol import Odometry, OdometryFrame, OdometryResult
from recon.odometry.registry import make_odometry
from recon.report.drive_figures import grid_figure, loops_figure, seen_from_above
from recon.sources.synthetic import SyntheticSource
from recon.street.settings import StreetScene
from recon.street.truth import true_surface

THRESHOLDS_M = (0.2, 0.4)
BAND_M = (0.3, 2.0)


class Filmed(SyntheticSource):
    """A drive whose images are rendered once and kept."""

    @cached_property
    def pairs(self) -> list[StereoPair]:
        """All stereo pairs."""
        return [self.camera.pair(index) for index in range(len(self))]

    def frames(self, first: int = 0) -> Iterator[StereoPair]:
        """The pairs, from frame ``first`` on."""
        return iter(self.pairs[first:])


@dataclass
class Drifting:
    """An odometry with added scale and heading drift.

    Attributes:
        inner: The original odometry.
        share: Relative excess length of each step.
        turn_deg_per_m: Excess rotation.
    """

    inner: Odometry
    ratio: float
    turn_deg_per_m: float

    def __post_init__(self) -> None:
        self._true, self._drifted = np.eye(4), np.eye(4)

    def register(self, frame: OdometryFrame) -> OdometryResult:
        """Register the next frame and add the drift of its step."""
        result = self.inner.register(frame)
        step = se3.invert(self._true) @ result.T_world_camera
        angle = np.radians(self.turn_deg_per_m) * float(np.linalg.norm(step[:3, 3]))
        turn = step[:3, :3] @ se3.exp_so3(np.array([0.0, angle, 0.0]))
        longer = se3.make_transform(turn, (1.0 + self.ratio) * step[:3, 3])
        self._true = result.T_world_camera
        self._drifted = se3.orthonormalise(self._drifted @ longer)
        return OdometryResult(self._drifted.copy(), result.health)

    def state(self) -> dict[str, Any]:
        """Everything that later poses depend on."""
        return {"inner": self.inner.state(), "true": self._true, "drifted": self._drifted}

    def restore(self, state: dict[str, Any]) -> None:
        """Continue from a state."""
        self.inner.restore(state["inner"])
        self._true, self._drifted = state["true"], state["drifted"]


def main(arguments: Sequence[str] | None = None) -> None:
    options = parse(arguments)
    result: dict[str, Any] = {"width": options.width, "seed": options.seed}
    config = config_of(options, "block")
    block = Filmed(config.street)
    result["block"] = closing(block, config, 0.0, options.pictures)
    result["drift"] = closing(block, config, options.drift_percent, options.pictures)
    result["alike"] = deceiving(Filmed(config_of(options, "alike").street), options)
    print(json.dumps(result, indent=2) if options.json else table(result))


def parse(arguments: Sequence[str] | None) -> argparse.Namespace:
    parser = argparse.ArgumentParser(description=__doc__.partition("\n")[0])
    parser.add_argument("--json", action="store_true", help="print JSON instead of a table")
    parser.add_argument("--width", type=int, default=480, help="width of the pictures")
    parser.add_argument("--seed", type=int, default=1, help="another seed is another block")
    parser.add_argument("--frames", type=int, default=250, help="frames; a lap takes 230")
    parser.add_argument(
        "--drift-percent", type=float, default=1.0, help="planted drift; it turns as many °/100 m"
    )
    parser.add_argument("--pictures", type=Path, help="draw paths and grids into this folder")
    return parser.parse_args(arguments)


def config_of(options: argparse.Namespace, drive: str) -> ReconConfig:
    """The configuration of a street with small images."""
    street = {
        "seed": options.seed,
        "width_px": options.width,
        "height_px": options.width * 3 // 8,
        "focal_px": options.width * 0.5625,
        "smooth_edges": False,
    }
    if drive == "block":
        street |= {"path": "block", "block_m": [64, 60], "frames": options.frames}
    else:
        street |= {"path": "straight", "repeat_m": 50.0, "frames": 110}
    return load_config().model_copy(update={"street": StreetScene.parse(street)})


def closing(
    source: Filmed, config: ReconConfig, drift_percent: float, pictures: Path | None
) -> dict[str, Any]:
    """A drive around a block, before and after loop closure."""
    mapped, seconds = mapped_with(source, config, drift_percent)
    if mapped.loops is None:
        raise SystemExit("loop closure is off")
    surface = true_surface(source.camera, range_m=fusion_range_m(mapped.camera, config.fusion))
    before = without_loops(mapped)
    if pictures is not None:
        draw(pictures, "drift" if drift_percent else "block", before, mapped)
    frames = len(mapped.trajectory)
    return {
        "path_m": round(source.trajectory.path_length_m, 2),
        "before": quality(before, source, surface),
        "after": quality(mapped, source, surface),
        "loops": mapped.loops.figures().to_json(),
        "ms_per_frame": {name: round(1e3 * s / frames, 2) for name, s in seconds.items()},
    }


def without_loops(mapped: MappedSequence) -> MappedSequence:
    """Return a drive as it is before its loops are closed, with its path and cloud made."""
    closed, before = dict(mapped.session.loops), replace(mapped, loops=None)
    mapped.session.set_loops(NO_LOOPS)
    len(before.trajectory), len(before.cloud)  # made here, and kept
    mapped.session.set_loops(closed)
    return before


def deceiving(source: Filmed, options: argparse.Namespace) -> dict[str, Any]:
    """A repetitive street: loops closed, and loops found without the odometry check."""
    config = config_of(options, "alike")
    loops = mapped_with(source, config, 0.0)[0].loops
    with patch.multiple("recon.places.places", SHARE=1.0, TURN_DEG=5.0):
        trusting = mapped_with(source, config, 0.0)[0].loops
    if loops is None or trusting is None:
        raise SystemExit("loop closure is off")
    return {
        "path_m": round(source.trajectory.path_length_m, 2),
        "closed": len(loops.closure.closed),
        "found": loops.found,
        "found_if_odometry_were_not_asked": trusting.found,
        "path_unchanged": loops.closure.trajectory is loops.odometry,
    }


def mapped_with(
    source: Filmed, config: ReconConfig, drift_percent: float
) -> tuple[MappedSequence, dict[str, float]]:
    """Map the drive with drifting odometry; also the seconds of loop closure and of the run."""

    def drifting(method: str, settings: Any, prior: Any) -> Odometry:
        inner = make_odometry(method, settings, prior)
        return Drifting(inner, drift_percent / 100, drift_percent / 100) if drift_percent else inner

    work = Workspace()
    start = time.perf_counter()
    with patch("recon.map.drive.drive_odometry.make_odometry", drifting):
        mapped = map_sequence(source, config, workspace=work)
    seconds = {n: s for n, s in work.stopwatch.seconds.items() if "loops" in n}
    return mapped, seconds | {"all": time.perf_counter() - start}


def quality(mapped: MappedSequence, source: Filmed, surface: PointCloud) -> dict[str, Any]:
    """Errors of path and maps against the ground truth."""
    truth, path = source.trajectory, mapped.trajectory
    off_m = np.linalg.norm(path.positions_m - truth.positions_m, axis=1)
    # Maps are aligned first: a heading error in the first metres rotates the whole map.
    T_true_world = fit_points(path.positions_m, truth.positions_m).T_to_from
    cells, obstacles = footprints(mapped, surface, source, T_true_world)
    cloud = transform_cloud(mapped.cloud, T_true_world, frame="world")
    return {
        "end_error_m": round(float(off_m[-1]), 4),
        "end_error_percent": round(100 * float(off_m[-1]) / truth.path_length_m, 4),
        "rms_error_m": round(rms_m(path.positions_m, truth), 4),
        "aligned_rms_error_m": round(rms_m(se3.apply(T_true_world, path.positions_m), truth), 4),
        "cloud": [scores(cloud, surface, t) for t in THRESHOLDS_M],
        "grid": [scores(cells, obstacles, t) for t in THRESHOLDS_M],
    }


def scores(cloud: PointCloud, surface: PointCloud, threshold_m: float) -> dict[str, float]:
    metrics = evaluate_map(cloud, surface, threshold_m)
    return {
        "threshold_m": threshold_m,
        "precision": round(metrics.precision, 4),
        "recall": round(metrics.recall, 4),
        "f_score": round(metrics.f_score, 4),
        "median_m": round(metrics.median_m, 4),
    }


def rms_m(positions_m: Float64, truth: Trajectory) -> float:
    off_m = np.linalg.norm(positions_m - truth.positions_m, axis=1)
    return float(np.sqrt(np.mean(off_m**2)))


def footprints(
    mapped: MappedSequence, surface: PointCloud, source: Filmed, T_true_world: Float64
) -> tuple[PointCloud, PointCloud]:
    """Occupied cells of the flat grid and visible true obstacles, both projected to the ground."""
    T, grid = mapped.T_map_world, flat_grid(mapped)
    row, column = np.nonzero(grid.cells == OCCUPIED)
    cells_m = (np.column_stack([column, row]) + 0.5) * grid.resolution_m + grid.origin_m
    level = np.column_stack([cells_m, np.full(len(cells_m), -source.settings.camera_height_m)])
    # The grid is a plane near the road; it is projected vertically onto the true road.
    laid = se3.apply(source.world.T_map_world @ T_true_world @ se3.invert(T), level)
    true = se3.apply(source.world.T_map_world, surface.xyz.astype(np.float64))
    height_m = true[:, 2] + source.settings.camera_height_m
    standing = (height_m > BAND_M[0]) & (height_m < BAND_M[1])
    return on_the_ground(laid[:, :2]), on_the_ground(true[standing, :2])


def flat_grid(mapped: MappedSequence) -> OccupancyGrid:
    """The flat grid of a drive."""
    config, T = mapped.config, mapped.T_map_world
    cloud = transform_cloud(mapped.cloud, T, frame="map")
    path_m = se3.apply(T, mapped.trajectory.positions_m)
    floor = add_floors(cloud, find_floors(mapped.voxels))
    reach_m = config.occupancy.max_range_m
    ground = estimate_ground_surface(floor, path_m, config.ground, reach_m)
    return flatten(mapped.voxels, ground, config.grid)


def draw(folder: Path, name: str, before: MappedSequence, after: MappedSequence) -> None:
    """Draw path and grids before and after loop closure."""
    folder.mkdir(parents=True, exist_ok=True)
    if after.loops is None:
        return
    pairs = [(loop.first, loop.last) for loop in after.loops.closure.closed]
    drawn = loops_figure(before.trajectory, after.trajectory, pairs, after.T_map_world)
    (folder / f"{name}_path.png").write_bytes(drawn)
    for moment, mapped in (("before", before), ("after", after)):
        path = seen_from_above(mapped.trajectory, mapped.T_map_world)
        grid = grid_figure(flat_grid(mapped), {"path": path})
        (folder / f"{name}_grid_{moment}.png").write_bytes(grid)


def on_the_ground(xy_m: Float64) -> PointCloud:
    flat = np.column_stack([xy_m, np.zeros(len(xy_m))]).astype(np.float32)
    return PointCloud(flat, frame="map")


def table(result: dict[str, Any]) -> str:
    lines = []
    for name in ("block", "drift"):
        row = result[name]
        lines.append(f"{name}: {row['path_m']} m, {row['loops']['closed']} loops closed")
        for moment in ("before", "after"):
            q = row[moment]
            lines.append(
                f"  {moment:6s} end off by {q['end_error_m']:.3f} m ({q['end_error_percent']:.3f} "
                f"%), cloud F {q['cloud'][0]['f_score']:.3f}, grid F {q['grid'][0]['f_score']:.3f}"
            )
    row = result["alike"]
    lines.append(
        f"alike: {row['closed']} closed; {row['found_if_odometry_were_not_asked']} would be found "
        "if odometry were not asked"
    )
    return "\n".join(lines)


if __name__ == "__main__":
    main()
