"""Maps of a real street: the road is free, the objects beside it are occupied."""

from __future__ import annotations

from pathlib import Path

import cv2
import numpy as np
import pytest

from recon.core.geometry.se3 import apply
from recon.core.values import FREE, OCCUPIED, PointCloud
from recon.map.fusion import CloudBuilder, FusionSettings
from recon.map.ground.axes import AxesSettings, estimate_ground, map_axes
from recon.map.ground.grid import GridSettings, flatten
from recon.map.ground.surface import GroundSettings, estimate_ground_surface
from recon.map.occupancy.builder import OccupancyBuilder, OccupancySettings

FRAMES = range(0, 36, 2)


def _poses(drive: Path) -> np.ndarray:
    rows = np.loadtxt(drive / "poses.txt").reshape(-1, 3, 4)
    bottom = np.tile([[0.0, 0.0, 0.0, 1.0]], (len(rows), 1, 1))
    return np.concatenate([rows, bottom], axis=1)


def _cloud(drive: Path, index: int) -> PointCloud:
    """A frame by OpenCV's matcher: these tests need no matcher of ours."""
    left, right = (
        cv2.imread(str(sorted((drive / side).glob("*.png"))[index]), cv2.IMREAD_GRAYSCALE)
        for side in ("image_0", "image_1")
    )
    lines = (drive / "calib.txt").read_text().splitlines()
    P1 = next(np.array(line.split()[1:], float) for line in lines if line.startswith("P1:"))
    f, cx, cy, b = P1[0], P1[2], P1[6], -P1[3] / P1[0]
    matcher = cv2.StereoSGBM_create(
        numDisparities=96, blockSize=5, P1=200, P2=800, disp12MaxDiff=1, uniquenessRatio=10,
        speckleWindowSize=100, speckleRange=2, mode=cv2.STEREO_SGBM_MODE_SGBM_3WAY,
    )  # fmt: skip
    disparity = matcher.compute(left, right).astype(np.float32) / 16
    v, u = np.nonzero(disparity > f * b / 40)
    z = f * b / disparity[v, u]
    xyz = np.stack([(u - cx) * z / f, (v - cy) * z / f, z], axis=1).astype(np.float32)
    return PointCloud(xyz, sigma_m=(0.4 * z**2 / (f * b)).astype(np.float32))


@pytest.mark.real
@pytest.mark.slow
def test_the_driven_road_is_free_and_has_obstacles_beside_it(recon_data: Path) -> None:
    drive = recon_data / "driven" / "kitti_06_51"
    poses = _poses(drive)[FRAMES]
    clouds = [_cloud(drive, index) for index in FRAMES]
    T_map_world = map_axes(estimate_ground(clouds[0]), AxesSettings())
    fused = CloudBuilder(FusionSettings(min_count=2))
    occupancy = OccupancyBuilder(OccupancySettings(), T_map_world)
    for cloud, T in zip(clouds, poses, strict=True):
        world = PointCloud(apply(T, cloud.xyz), sigma_m=cloud.sigma_m, frame="world")
        fused.integrate(world)
        occupancy.integrate(cloud, T)
    path = apply(T_map_world, poses[:, :3, 3])
    cloud_map = PointCloud(apply(T_map_world, fused.cloud().xyz), frame="map")
    ground = estimate_ground_surface(cloud_map, path, GroundSettings())
    grid = flatten(occupancy.voxels(), ground, GridSettings())
    # KITTI's cameras are mounted 1.65 m above ground.
    assert 1.55 < ground.camera_height_m < 1.75
    # The lane, 2 m wide; the first metres lie below the image and are never seen.
    driven = path[path[:, 0] > 8]
    lane = np.concatenate(
        [driven + np.array([0.0, side, 0.0]) for side in np.arange(-1.0, 1.1, 0.2)]
    )
    column, row = ((lane[:, :2] - grid.origin_m) / grid.resolution_m).astype(int).T
    assert (grid.cells[row, column] == FREE).all()
    # Parked cars and poles: some of the area, not most of it.
    share = (grid.cells == OCCUPIED).sum() / (grid.cells != -1).sum()
    assert 0.005 < share < 0.15
