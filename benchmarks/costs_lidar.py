"""What a costmap of a drive says of ground that its LiDAR map knows.

The LiDAR map is put into the axes of ours by the two paths, frame by frame, so that only what is
near counts. In the cells of the costmap it says:
- ``drivable``: within half the width of the robot no height differs from that of the cell beside it
  by more than the highest step, the slope is below the limit, and nothing stands there;
- ``step``: the ground beside is more than 15 cm higher or lower, or something of that height is in
  the cell;
- ``alone``: the same, but the road is seen on all sides of it, and below: a car that passed, which
  leaves a trail in the map, or a pole. It counts as neither, as do cells of which too little is
  known.

Example: python benchmarks/costs_lidar.py DRIVE lidar_map.ply poses.txt --json
"""

from __future__ import annotations

import argparse
import json
import tempfile
from collections.abc import Iterator, Sequence
from itertools import product
from pathlib import Path
from typing import Any, Final, NamedTuple
from unittest.mock import patch

import checkout  # noqa: F401 - what is measured
import cv2
import numpy as np
from scipy.spatial import cKDTree

from recon.commands.config import load_config
from recon.commands.map import run_map
from recon.commands.map_options import MapOptions
from recon.core.values import FREE, OCCUPIED, UNKNOWN, OccupancyGrid
from recon.core.values.arrays import Bool, Float64
from recon.export.costmap import make_costmap
from recon.io.images.image import write_image
from recon.io.models.ply import read_ply
from recon.io.trajectory import read_kitti_poses
from recon.map.ground.surface import Raster
from recon.map.ground.traverse import UNSURE, RobotSettings
from recon.map.map import Map
from recon.map.sessions.placed import place_map
from recon.sources.registry import open_source

ROBOT: Final = ("robot.width_m=0.5", "robot.wheel_radius_m=0.1")  # of docs/walk-robot.md
STEP_M: Final = 0.15
DRIVABLE_M, STEPS_M = 6.0, 8.0  # of the path, within which cells count
SMOOTH_M: Final = 6.0  # of the path, over which the alignment is averaged
FLAT_M: Final = 0.03  # off a plane, of LiDAR
HIGH_M: Final = 2.0  # above the lowest point of a cell: higher ones are passed under
PLANE, ALONE = 2, 3  # cells around one, in which planes are looked for


class Known(NamedTuple):
    """What LiDAR says of cells; (rows, columns)."""

    drivable: Bool
    step: Bool
    alone: Bool
    away_m: Float64  # from the path


def main(arguments: Sequence[str] | None = None) -> None:
    options = parse(arguments)
    found = measured(options)
    print(json.dumps(found) if options.json else json.dumps(found, indent=1))


def parse(arguments: Sequence[str] | None) -> argparse.Namespace:
    parser = argparse.ArgumentParser(description=__doc__.partition("\n")[0])
    parser.add_argument("drive", type=Path)
    parser.add_argument("reference", type=Path, help="cloud in the axes of the poses, PLY")
    parser.add_argument("poses", type=Path, help="true poses of the left camera")
    parser.add_argument("--json", action="store_true")
    parser.add_argument("--set", action="append", default=[], help="a setting, as recon takes it")
    parser.add_argument("--picture", type=Path, help="PNG: the costmap above what LiDAR says")
    return parser.parse_args(arguments)


def measured(options: argparse.Namespace) -> dict[str, Any]:
    """Map the drive and make its costmap, as docs/walk-robot.md does."""
    with tempfile.TemporaryDirectory() as folder:
        run = Path(folder) / "run"
        how = MapOptions(out=run, mesh=False, audit=False)
        run_map(open_source(options.drive), load_config(None, options.set), how)
        config = load_config(run / "config.yaml", ROBOT)
        with Map.open(run) as map_:
            placed = place_map(map_, config)
            with patch("recon.export.costmap.widened", lambda grid, *_: grid):
                ground, _ = make_costmap(map_, placed)
            robot, _ = make_costmap(map_, placed)
            T_map_camera = map_.first.T_map_world @ map_.first.trajectory.T_world_camera
    points = aligned(T_map_camera, options.reference, options.poses)
    raster = Raster(robot.origin_m, robot.resolution_m, robot.cells.shape)
    known = classified(*points, raster, config.robot)
    if options.picture:
        write_image(options.picture, picture(robot, known))
    return {"of the ground": compared(ground, known), "of the robot": compared(robot, known)}


def aligned(T_map_camera: Float64, reference: Path, poses: Path) -> tuple[Float64, Float64]:
    """Points (N, 3) of the reference in map axes, and how far they are from the path (N,)."""
    xyz = read_ply(reference).xyz.astype(np.float64)
    T_true = read_kitti_poses(poses).T_world_camera
    T_map_true = T_map_camera @ np.linalg.inv(T_true)
    ways = T_true[:, [0, 2], 3]
    weight = np.exp(-0.5 * (np.linalg.norm(ways[:, None] - ways, axis=2) / SMOOTH_M) ** 2)
    weight /= weight.sum(axis=1, keepdims=True)
    T_map_true = np.einsum("nk,kij->nij", weight, T_map_true)
    away_m, nearest = cKDTree(ways).query(xyz[:, [0, 2]])
    T = T_map_true[nearest]
    return np.einsum("nij,nj->ni", T[:, :3, :3], xyz) + T[:, :3, 3], away_m


def classified(xyz: Float64, away_m: Float64, raster: Raster, robot: RobotSettings) -> Known:
    cell, inside = raster.cells_of(xyz[:, :2])
    cell, z = cell[inside], xyz[inside, 2]
    low, near, high = (np.full(raster.shape, start) for start in (np.inf, np.inf, -np.inf))
    np.minimum.at(low.reshape(-1), cell, z)
    np.minimum.at(near.reshape(-1), cell, away_m[inside])
    below = z < low.reshape(-1)[cell] + HIGH_M
    np.maximum.at(high.reshape(-1), cell[below], z[below])
    lowest = z < low.reshape(-1)[cell] + 0.1
    sums = (np.bincount(cell[lowest], w, low.size) for w in (z[lowest], np.ones(lowest.sum())))
    with np.errstate(invalid="ignore"):
        height_m = np.divide(*sums).reshape(raster.shape)
    seen = np.isfinite(height_m)
    differs = differences(height_m)
    odd = seen & ((high - low > STEP_M) | (differs > STEP_M))
    reach = int(robot.width_m / 2 / raster.cell_m)
    y, x = np.mgrid[-reach : reach + 1, -reach : reach + 1]
    around = (np.hypot(x, y) <= robot.width_m / 2 / raster.cell_m).astype(np.uint8)
    steep, count = plane(height_m, seen, PLANE, raster.cell_m)
    most = (2 * PLANE + 1) ** 2
    drivable = seen & (count >= 0.8 * most) & (cv2.dilate(differs, around) <= robot.step_m)
    drivable &= np.linalg.norm(steep[..., 1:], axis=-1) < robot.max_slope_percent / 100
    drivable &= cv2.dilate(odd.astype(np.uint8), around) == 0
    alone = odd & on_a_road(height_m, seen & ~odd, raster.cell_m)
    return Known(drivable, odd & ~alone, alone, near)


def differences(height_m: Float64) -> Float64:
    """Largest difference of a height to those of the eight cells beside it; unknown counts as 0."""
    most = np.zeros_like(height_m)
    padded = np.pad(height_m, 1, constant_values=np.nan)
    rows, columns = height_m.shape
    for r, c in product(range(3), repeat=2):
        most = np.fmax(most, np.abs(padded[r : r + rows, c : c + columns] - height_m))
    return most


def plane(z: Float64, used: Bool, reach: int, cell_m: float) -> tuple[Float64, Float64]:
    """Height and slopes (..., 3) of the plane through cells around each, and how many are used."""
    y, x = np.mgrid[-reach : reach + 1, -reach : reach + 1] * cell_m
    basis, weight = (np.ones_like(x), x, y), used.astype(np.float64)
    known = np.where(used, z, 0.0)

    def summed(values: Float64, kernel: Float64) -> Float64:
        found = cv2.filter2D(values, cv2.CV_64F, kernel, borderType=cv2.BORDER_CONSTANT)
        return np.asarray(found, np.float64)

    right = np.stack([summed(known, one) for one in basis], axis=-1)
    normal = np.stack([summed(weight, a * b) for a, b in product(basis, repeat=2)], axis=-1)
    normal = normal.reshape(*z.shape, 3, 3)
    count = normal[..., 0, 0].copy()
    beta = np.linalg.solve(normal + 1e-6 * np.eye(3), right[..., None])[..., 0]
    return np.asarray(beta, np.float64), np.asarray(count, np.float64)


def on_a_road(height_m: Float64, ground: Bool, cell_m: float) -> Bool:
    """Whether most cells around each, on all four sides, are on the plane of the ground there."""
    beta, count = plane(height_m, ground, ALONE, cell_m)
    sides, total = np.zeros((4, *height_m.shape)), np.zeros(height_m.shape)
    for r, c, off_m in off_plane(height_m, beta, cell_m):
        total += off_m < FLAT_M
        if r and c:
            sides[2 * (r > 0) + (c > 0)] += off_m < FLAT_M
    width = 2 * ALONE + 1
    enough = count >= width**2 / 4
    return np.asarray(enough & (total >= 0.6 * width**2) & (sides.min(axis=0) >= 4))


def off_plane(
    height_m: Float64, beta: Float64, cell_m: float
) -> Iterator[tuple[int, int, Float64]]:
    padded = np.pad(height_m, ALONE, constant_values=np.nan)
    rows, columns = height_m.shape
    for r, c in product(range(-ALONE, ALONE + 1), repeat=2):
        there = padded[ALONE + r :, ALONE + c :][:rows, :columns]
        yield r, c, np.abs(there - beta @ [1.0, c * cell_m, r * cell_m])


def compared(costs: OccupancyGrid, known: Known) -> dict[str, dict[str, int]]:
    """How many cells of each kind have which costs."""
    kinds = {
        "drivable": known.drivable & (known.away_m < DRIVABLE_M),
        "step": known.step & (known.away_m < STEPS_M),
        "alone": known.alone & (known.away_m < STEPS_M),
    }
    return {name: states(costs.cells[which]) for name, which in kinds.items()}


def states(cells: Any) -> dict[str, int]:
    kinds = {
        "free": cells == FREE,
        "graded": (cells > FREE) & (cells < OCCUPIED),
        "obstacle": cells == OCCUPIED,
        "unsure": cells == UNSURE,
        "unknown": cells == UNKNOWN,
    }
    return {name: int(which.sum()) for name, which in kinds.items()}


def picture(costs: OccupancyGrid, known: Known) -> Any:
    """Draw costs (white to orange, obstacles red, unsure grey) above what LiDAR says.

    Green is drivable, red a step, yellow what stands alone.
    """
    cells = costs.cells[..., None]
    graded = np.array([255, 255, 255]) - np.maximum(cells, 0) * np.array([0.0, 1.3, 2.5])
    above = np.select(
        [cells == OCCUPIED, cells == UNSURE, cells == UNKNOWN],
        [np.array([180, 0, 0]), np.array([150, 150, 150]), np.array([40, 60, 90])], graded,
    )  # fmt: skip
    below = np.zeros_like(above)
    for which, colour in zip(known, ([0, 200, 0], [255, 0, 0], [255, 255, 0]), strict=False):
        below[which] = colour
    rows, columns = np.nonzero(known.away_m < 10.0)
    part = np.s_[rows.min() : rows.max() + 1, columns.min() : columns.max() + 1]
    both = np.vstack([above[part][::-1], below[part][::-1]]).astype(np.uint8)
    return cv2.resize(both, None, fx=3, fy=3, interpolation=cv2.INTER_NEAREST)


if __name__ == "__main__":
    main()
