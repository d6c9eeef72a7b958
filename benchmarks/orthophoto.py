"""How near to their true places an orthophoto has things, by patches that are matched.

That of the street of `recon demo` is compared with the street rendered from 5 km above. That of a
drive, as mapped and held at its true positions with noise by `recon merge`, is compared with a
picture that shares no code with it: true poses, the ground of the LiDAR, the nearest image.
`off` is the shift of each patch of 64 cells for which the match is best, by phase correlation.

Example: python benchmarks/orthophoto.py --drive DRIVE --json
    The drive is in KITTI's layout, with poses.txt and lidar_map.ply in its folder.
"""

from __future__ import annotations

import argparse
import json
import tempfile
from functools import partial
from pathlib import Path
from typing import Any, Final

import checkout  # noqa: F401 - what is measured
import cv2
import numpy as np
import rasterio
from numpy.typing import NDArray
from scipy.spatial import cKDTree

from recon.commands.config import load_config, run_settings
from recon.commands.demo import run_demo
from recon.commands.export import run_export
from recon.commands.map import run_map
from recon.commands.map_options import MapOptions
from recon.commands.merge import run_merge
from recon.core.geometry.se3 import apply, invert, make_transform
from recon.core.values.arrays import Float64
from recon.io.images.image import read_image
from recon.io.models.ply import read_ply
from recon.io.trajectory import read_kitti_poses, read_tum
from recon.map.ground.axes import AXES_MAP_WORLD
from recon.map.sessions.measured import Survey
from recon.sources.registry import open_source
from recon.sources.synthetic import SyntheticSource
from recon.street.materials import GAMMA
from recon.street.settings import StreetSettings

PATCH_PX: Final = 64
LEAST_RESPONSE: Final = 0.1  # of a match; a patch of even asphalt has none
FROM_M: Final = 5000.0  # so high that a roof is seen a centimetre aside
NOISE_M: Final = 0.05
STATED_M: Final = 0.1  # by the file of positions: the poses of the LiDAR err, too
NEAR_M: Final = 14.0
SQUARE_M: Final = 0.5
CAMERA_M: Final = 1.65  # KITTI's, above the ground


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.partition("\n")[0])
    parser.add_argument("--drive", type=Path)
    parser.add_argument("--json", action="store_true")
    given = parser.parse_args()
    with tempfile.TemporaryDirectory() as folder:
        found = {"rendered street": of_street(Path(folder) / "street")}
        if given.drive is not None:
            found |= of_drive(given.drive, Path(folder) / "drive")
    if given.json:
        print(json.dumps(found))
        return
    for name, figures in found.items():
        print(f"{name:30}", figures)


def of_street(folder: Path) -> dict[str, Any]:
    run, out = folder / "run", folder / "out"
    run_demo(load_config(), out=run, mesh=False)
    run_export(run, products=("orthophoto",), out=out)
    return against_street(run, out / "map/orthophoto.tif")


def of_drive(drive: Path, folder: Path) -> dict[str, dict[str, Any]]:
    run, held, positions = folder / "run", folder / "held", folder / "positions.txt"
    run_map(open_source(drive), load_config(), MapOptions(out=run, mesh=False, audit=False))
    T_up_world = make_transform(AXES_MAP_WORLD, np.zeros(3))
    places = apply(T_up_world, read_kitti_poses(drive / "poses.txt").positions_m)
    places += np.random.default_rng(4).normal(size=places.shape) * NOISE_M
    times_s = read_tum(run / "trajectory_tum.txt").timestamps_s
    np.savetxt(positions, np.column_stack([times_s, places, np.full(len(places), STATED_M)]))
    survey = Survey(positions)
    run_merge([run], options=MapOptions("merge", held, mesh=False), survey=survey)
    photo = partial(run_export, products=("orthophoto",), images=(drive,))
    told = photo(run, out=folder / "mapped").to_json()
    photo(held, out=folder / "surveyed", survey=survey)
    ways = {"as mapped": np.array(told["T_map_world"]), "held at positions": T_up_world}
    pictures = (folder / name / "map/orthophoto.tif" for name in ("mapped", "surveyed"))
    return {
        f"{drive.name}, {way}": against_drive(drive, T_file_world, picture)
        for (way, T_file_world), picture in zip(ways.items(), pictures, strict=True)
    }


def against_drive(drive: Path, T_file_world: Float64, picture: Path) -> dict[str, Any]:
    """Compare an orthophoto of a drive with what its true poses and LiDAR make of its images."""
    with rasterio.open(picture) as file:
        ours, cell_m, (west, north) = file.read(), file.res[0], (file.bounds.left, file.bounds.top)
    lines = (drive / "calib.txt").read_text().splitlines()
    P = np.array(next(one for one in lines if one.startswith("P0")).split()[1:], float)
    focal, cx, cy = P[[0, 2, 6]]
    poses = np.loadtxt(drive / "poses.txt").reshape(-1, 3, 4)
    poses = np.stack([T_file_world @ np.vstack([pose, [0, 0, 0, 1]]) for pose in poses])
    row, column = np.indices(ours.shape[1:])
    x, y = west + (column + 0.5) * cell_m, north - (row + 0.5) * cell_m
    points = apply(T_file_world, read_ply(drive / "lidar_map.ply").xyz.astype(np.float64))
    xyz = np.dstack([x, y, _ground(points, poses[:, :3, 3], x, y)])
    nearest, true = np.zeros(x.shape), np.zeros(x.shape)
    for number, T in enumerate(poses):
        top, left = np.maximum(
            ((north - T[1, 3] - NEAR_M) / cell_m, (T[0, 3] - NEAR_M - west) / cell_m), 0
        ).astype(int)
        width = int(2 * NEAR_M / cell_m)
        at = np.s_[top : top + width, left : left + width]
        right, down, ahead = np.moveaxis((xyz[at] - T[:3, 3]) @ T[:3, :3], -1, 0)
        image = read_image(drive / f"image_0/{number:010d}.png")
        with np.errstate(all="ignore"):
            u, v = focal * right / ahead + cx, focal * down / ahead + cy
        inside = (
            (ahead > 2) & (u > 0) & (v > 0) & (u < image.shape[1] - 1) & (v < image.shape[0] - 1)
        )
        score = np.where(inside, 1 / np.maximum(ahead, 1), 0)
        better = score > nearest[at]
        where = np.nan_to_num([u, v]).astype(np.float32)
        true[at][better] = cv2.remap(image, where[0], where[1], cv2.INTER_LINEAR)[better]
        nearest[at][better] = score[better]
    return shifts(ours[:3].mean(axis=0), true, (ours[3] > 0) & (nearest > 0), cell_m)


def _ground(points: Float64, eyes: Float64, x: Float64, y: Float64) -> Float64:
    """Return heights of the LiDAR's ground at places: medians around squares of half a metre."""
    away, eye = cKDTree(eyes[:, :2]).query(points[:, :2])
    height = points[:, 2] - eyes[eye, 2] + CAMERA_M
    ground = points[(away < NEAR_M) & (np.abs(height) < 0.4)]
    shape = int(np.ptp(y) / SQUARE_M) + 2, int(np.ptp(x) / SQUARE_M) + 2
    down, right = np.indices(shape)
    west, north = x.min(), y.max()
    middles = np.stack([west + right.ravel() * SQUARE_M, north - down.ravel() * SQUARE_M], axis=1)
    near = cKDTree(ground[:, :2]).query_ball_point(middles, SQUARE_M)
    medians = [np.median(ground[own, 2]) if len(own) > 3 else np.nan for own in near]
    heights = np.array(medians, np.float32).reshape(shape)
    where = (((x - west) / SQUARE_M), ((north - y) / SQUARE_M))
    column, row = (one.astype(np.float32) for one in where)
    found = cv2.remap(heights, column, row, cv2.INTER_LINEAR, borderValue=np.nan)
    return np.asarray(found, np.float64)


def against_street(run: Path, picture: Path) -> dict[str, Any]:
    """Compare the orthophoto of a run of a rendered street with the street from above."""
    street = StreetSettings.model_validate(dict(run_settings(run).street))
    summary = json.loads((run / "summary.json").read_text())
    source = SyntheticSource(street)
    T_street_map = invert(np.array(summary["T_map_world"]) @ source.world.T_world_street)
    with rasterio.open(picture) as file:
        ours, cell_m, (west, north) = file.read(), file.res[0], (file.bounds.left, file.bounds.top)
    row, column = np.indices(ours.shape[1:])
    level = -source.settings.camera_height_m
    xyz = np.stack([west + (column + 0.5) * cell_m, north - (row + 0.5) * cell_m], axis=-1)
    xyz = np.pad(xyz.reshape(-1, 2), ((0, 0), (0, 1)), constant_values=level)
    eye = np.append(xyz[:, :2].mean(axis=0), FROM_M)
    rays = (xyz - eye) @ T_street_map[:3, :3].T / (FROM_M - level)
    seen = source.camera.stage.look(apply(T_street_map, eye[None])[0], rays, cell_m / FROM_M)
    true = 255 * seen.rgb.reshape(*row.shape, 3) ** (1 / GAMMA)
    return shifts(ours[:3].mean(axis=0), true.mean(axis=2), ours[3] > 0, cell_m)


def shifts(one: Float64, other: Float64, known: NDArray[np.bool_], cell_m: float) -> dict[str, Any]:
    """Return by how much patches of two pictures lie apart, in metres and cells."""
    window = cv2.createHanningWindow((PATCH_PX, PATCH_PX), cv2.CV_64F)
    found = []
    for row in range(0, one.shape[0] - PATCH_PX, PATCH_PX // 2):
        for column in range(0, one.shape[1] - PATCH_PX, PATCH_PX // 2):
            at = np.s_[row : row + PATCH_PX, column : column + PATCH_PX]
            if known[at].mean() < 1:
                continue
            ours, theirs = (
                np.ascontiguousarray(each[at] - each[at].mean()) for each in (one, other)
            )
            shift, response = cv2.phaseCorrelate(ours, theirs, window)
            if response > LEAST_RESPONSE:
                found.append(shift)
    off = np.hypot(*np.array(found).T)
    median, most = np.quantile(off, (0.5, 0.95)).tolist()
    return {
        "cell": cell_m,
        "patches": len(off),
        "median": median * cell_m,
        "95 %": most * cell_m,
        "median in cells": median,
        "95 % in cells": most,
    }


if __name__ == "__main__":
    main()
