"""Values show themselves in one short line, as in a notebook; never their whole arrays."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

import recon
from recon.core.values import RayCloud
from tests.core.values.test_values import CAMERA, calibration, rectified_pair, stereo_pair

ZEROS = np.zeros((500, 3), np.float32)
POSES = np.tile(np.eye(4), (40, 1, 1))
POSES[:, 2, 3] = np.arange(40) / 2
TRAJECTORY = recon.Trajectory(POSES, np.arange(40) / 10)
CELLS = np.full((30, 20), -1, np.int8)
CELLS[:3], CELLS[3:6] = 0, 100
SHARES = np.zeros(500, np.float16), np.zeros(500, np.uint8), np.zeros(500, np.uint8)
SHOWN = {
    recon.Disparity.from_values([[1, 2], [0, 5]]): "Disparity(2x2, 1 to 5 px, 75.0 % valid)",
    recon.Disparity.from_values([[0, 0]]): "Disparity(2x1, 0 % valid)",
    recon.DisparityTruth.from_values([[1, 2.5, np.inf, 0]], [[True, False, True, True]]): (
        "DisparityTruth(4x1, 1 to 2.5 px, 50.0 % known, 25.0 % not occluded)"
    ),
    stereo_pair(name="im0.png", index=3): "StereoPair('im0.png', 6x4 grey, frame 3)",
    rectified_pair(): "RectifiedPair(grey, frame 0, RectifiedCamera(focal_px=700.0, cx_px=3.0, "
    "cy_px=2.0, cx_right_px=5.0, baseline_m=0.5, width_px=6, height_px=4, ndisp=33))",
    calibration(): "StereoCalibration(baseline 0.5 m, "
    + ", ".join(
        2
        * ["CameraIntrinsics(6x4, fx 500, fy 500, cx 0, cy 0 px, pinhole [0, 0, 0, 0, 0])"]
    )
    + ")",
    recon.PointCloud(ZEROS, rgb=ZEROS.astype(np.uint8)): (
        "PointCloud(500 points, x 0 to 0, y 0 to 0, z 0 to 0 m, camera axes, rgb)"
    ),
    recon.PointCloud(ZEROS[:0]): "PointCloud(0 points, empty, camera axes)",
    TRAJECTORY: "Trajectory(40 poses, 19.5 m, 3.9 s)",
    replace(TRAJECTORY, T_world_camera=POSES[:0], timestamps_s=np.zeros(0)): (
        "Trajectory(0 poses, 0 m, 0 s)"
    ),
    recon.OccupancyVoxels(ZEROS.astype(np.int32), ZEROS[:, 0] + 1, 0.2): (
        "OccupancyVoxels(500 voxels of 0.2 m, 500 occupied)"
    ),
    recon.OccupancyGrid(CELLS, 0.1, (-1.0, 2.0)): (
        "OccupancyGrid(20x30 cells of 0.1 m, 10.0 % occupied, 10.0 % free, origin (-1.0, 2.0) m)"
    ),
    recon.TriangleMesh(ZEROS, ZEROS.astype(np.int32)): (
        "TriangleMesh(500 faces, 500 vertices, x 0 to 0, y 0 to 0, z 0 to 0 m)"
    ),
    RayCloud(ZEROS.astype(np.int16), *SHARES, 0.01): "RayCloud(500 rays)",
}  # fmt: skip


@pytest.mark.parametrize("value", SHOWN, ids=lambda value: type(value).__name__)
def test_a_value_is_shown_in_one_line(value: object) -> None:
    assert repr(value) == SHOWN[value]


def test_settings_show_what_differs_from_the_defaults() -> None:
    assert repr(recon.load_config()) == "ReconConfig()"
    config = recon.load_config(overrides=["matching.matcher=sgm", "matching.sad.window_px=7"])
    assert repr(config) == (
        "ReconConfig(matching=MatchingSettings(matcher='sgm', sad=SadSettings(window_px=7)))"
    )


def test_results_of_a_pair_show_their_parts() -> None:
    noise = np.random.default_rng(0).integers(0, 256, (40, 80), dtype=np.uint8)
    camera = replace(CAMERA, width_px=80, height_px=40, ndisp=16)
    settings = recon.load_config(overrides=["matching.matcher=opencv-bm"])
    frame = recon.reconstruct(noise[:, :80], noise[:, :80], camera, settings)
    assert "\n" not in repr(frame)
    assert len(repr(frame)) < 500
