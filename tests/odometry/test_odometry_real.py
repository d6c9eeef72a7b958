"""Real drives: the accuracy the project promises, with its own matcher."""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path

import cv2
import numpy as np
import pytest

from recon.core.values import RectifiedCamera, RectifiedPair, Trajectory, TrajectoryMetrics
from recon.evaluation.trajectory import evaluate_trajectory
from recon.odometry.protocol import OdometryFrame, OdometryHealth
from recon.odometry.registry import make_odometry
from recon.stereo.match.registry import make_matcher

pytestmark = [pytest.mark.real, pytest.mark.slow]


def frames(folder: Path, stride: int) -> Iterator[OdometryFrame]:
    matcher = make_matcher("sad")
    left = sorted((folder / "image_0").glob("*.png"))[::stride]
    for index, path in enumerate(left):
        pair = [
            cv2.imread(str(side), cv2.IMREAD_GRAYSCALE)
            for side in (path, folder / "image_1" / path.name)
        ]
        camera = read_camera(folder / "calib.txt", *pair[0].shape)
        rectified = RectifiedPair(pair[0], pair[1], camera, index=index)
        yield OdometryFrame(rectified, matcher.match(rectified))


def read_camera(path: Path, height_px: int, width_px: int) -> RectifiedCamera:
    rows = dict(line.split(":", 1) for line in path.read_text().splitlines() if ":" in line)
    P0, P1 = (np.array(rows[key].split(), dtype=np.float64).reshape(3, 4) for key in ("P0", "P1"))
    return RectifiedCamera(
        focal_px=P0[0, 0],
        cx_px=P0[0, 2],
        cy_px=P0[1, 2],
        cx_right_px=P1[0, 2],
        baseline_m=-P1[0, 3] / P1[0, 0],
        width_px=width_px,
        height_px=height_px,
    )


def drive(folder: Path, stride: int) -> tuple[TrajectoryMetrics, list[OdometryHealth]]:
    """Errors and health of the visual odometry."""
    if not folder.is_dir():
        pytest.skip(f"real data: no folder {folder.name}")
    odometry = make_odometry("visual")
    results = [odometry.register(frame) for frame in frames(folder, stride)]
    truth = np.tile(np.eye(4), (len(results), 1, 1))
    truth[:, :3] = np.loadtxt(folder / "poses.txt").reshape(-1, 3, 4)[::stride]
    times = np.arange(len(truth), dtype=np.float64)
    path = Trajectory(np.stack([result.T_world_camera for result in results]), times)
    found = evaluate_trajectory(path, Trajectory(truth, times))
    return found, [result.health for result in results]


@pytest.mark.parametrize(
    ("name", "stride", "t_bound", "r_bound"),
    [
        ("kitti_raw_0013", 1, 0.35, 0.65),
        ("kitti_raw_0013", 3, 0.40, 0.65),
        ("kitti_06_51", 1, 0.80, 1.5),
        ("kitti_06_51", 3, 0.95, 1.8),
    ],
)
def test_real_drives_drift_as_little_as_promised_and_raise_no_alarm(
    name: str, stride: int, t_bound: float, r_bound: float, recon_data: Path
) -> None:
    found, health = drive(recon_data / "driven" / name, stride)
    assert 0.0 < found.t_rel_percent < t_bound
    assert 0.0 < found.r_rel_deg_per_100m < r_bound
    assert all(record.ok for record in health)
