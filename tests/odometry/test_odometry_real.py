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


def drive(folder: Path, stride: int) -> tuple[dict[str, TrajectoryMetrics], list[OdometryHealth]]:
    """Visual and fused odometry over the same frames, with their health."""
    if not folder.is_dir():
        pytest.skip(f"real data: no folder {folder.name}")
    odometries = {name: make_odometry(name) for name in ("visual", "fused")}
    poses: dict[str, list[np.ndarray]] = {name: [] for name in odometries}
    health = []
    for frame in frames(folder, stride):
        for name, odometry in odometries.items():
            result = odometry.register(frame)
            poses[name].append(result.T_world_camera)
            health.append(result.health)
    truth = np.tile(np.eye(4), (len(poses["visual"]), 1, 1))
    truth[:, :3] = np.loadtxt(folder / "poses.txt").reshape(-1, 3, 4)[::stride]
    times = np.arange(len(truth), dtype=np.float64)
    metrics = {
        name: evaluate_trajectory(Trajectory(np.stack(T), times), Trajectory(truth, times))
        for name, T in poses.items()
    }
    return metrics, health


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
    metrics, health = drive(recon_data / "driven" / name, stride)
    for found in metrics.values():
        assert 0.0 < found.t_rel_percent < t_bound
        assert 0.0 < found.r_rel_deg_per_100m < r_bound
    # A correction that did not earn its place would make it worse; the rest is rounding.
    assert metrics["fused"].t_rel_percent <= metrics["visual"].t_rel_percent + 0.01
    assert all(record.ok for record in health)
