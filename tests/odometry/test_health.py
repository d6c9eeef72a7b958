from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from recon.core.geometry.se3 import as_transform
from recon.core.values import RectifiedCamera, Trajectory
from recon.odometry.health import (
    doubt_about,
    expected_drift,
    health_warnings,
    name_frames,
    stretches,
)
from recon.odometry.protocol import OdometryHealth

GOOD = OdometryHealth(scale_px=30.0, sigma_m=0.01, sigma_deg=0.02)


def path(frames: int = 101, step_m: float = 1.0) -> Trajectory:
    poses = np.tile(np.eye(4), (frames, 1, 1))
    poses[:, 2, 3] = step_m * np.arange(frames)
    return Trajectory(poses, np.arange(frames, dtype=np.float64))


def test_an_error_of_all_disparities_is_as_much_of_the_length(camera: RectifiedCamera) -> None:
    near = expected_drift(path(), [GOOD] * 101, camera)
    far = expected_drift(path(), [replace(GOOD, scale_px=3.0)] * 101, camera)
    assert near is not None
    assert far is not None
    # 0.1 px, and 0.02° at 260 px: 0.135 px together, beside 0.2 % of the baseline.
    assert near.rig_percent == pytest.approx(100 * np.hypot(0.1351 / 30.0, 0.002), rel=1e-3)
    assert far.rig_percent == pytest.approx(100 * np.hypot(0.1351 / 3.0, 0.002), rel=1e-3)
    assert far.rests_on_m == pytest.approx(260.0 * 0.5 / 3.0)


def test_a_path_on_far_points_is_warned_of_and_one_on_near_points_is_not(
    camera: RectifiedCamera,
) -> None:
    near = expected_drift(path(), [GOOD] * 101, camera)
    far = expected_drift(path(), [replace(GOOD, scale_px=3.0)] * 101, camera)
    assert near is not None
    assert far is not None
    assert near.warnings() == []
    assert far.warnings() == [
        "scale rests on points about 43 m away: the length of the path is certain to ± 9 % only"
    ]


def test_random_errors_scatter_as_stated(camera: RectifiedCamera) -> None:
    """Paths with errors of the stated size in each step, against the stated drift."""
    rng = np.random.default_rng(4)
    sigmas = np.repeat([GOOD.sigma_m, np.deg2rad(GOOD.sigma_deg)], 3) / np.sqrt(3)
    offs = []
    for _ in range(200):
        T = np.eye(4)
        for _ in range(100):
            step = np.array([0.0, 0.0, 1.0, 0.0, 0.0, 0.0]) + sigmas * rng.normal(size=6)
            T = T @ as_transform(step)
        offs.append(T[:3, 3] - [0.0, 0.0, 100.0])
    found = expected_drift(path(), [GOOD] * 101, camera)
    assert found is not None
    random = np.sqrt(found.percent**2 - found.rig_percent**2)
    scattered = float(np.sqrt(np.square(offs).sum(axis=1).mean()))
    # Of a turn about the direction of travel nothing is seen: a third less. 200 trials: ±5 %.
    assert 0.8 * random < scattered < 1.1 * random


def test_poses_that_were_not_measured_say_nothing(camera: RectifiedCamera) -> None:
    assert expected_drift(path(), [OdometryHealth()] * 101, camera) is None
    assert expected_drift(path(1), [GOOD], camera) is None
    lost = replace(GOOD, ok=False, scale_px=1.0)
    some = expected_drift(path(), [GOOD, lost] + [GOOD] * 99, camera)
    assert some is not None
    assert some.rig_percent < 1.0


LOST = OdometryHealth(ok=False, notes=("dark",))
SKIPPED = replace(LOST, skipped=True)
FINE = OdometryHealth()


def test_lost_frames_are_named_by_stretches() -> None:
    assert health_warnings([FINE] * 3) == []
    lines = health_warnings([FINE, LOST, LOST, FINE, LOST, *[FINE] * 30])
    assert [line.split(":")[0] for line in lines] == ["frames 1-2", "frame 4"]
    assert all("dark" in line for line in lines)
    first, *others = health_warnings([FINE, *[LOST] * 3, *[FINE] * 16])
    assert first.startswith("PATH AND MAP ARE NOT TO BE TRUSTED")
    assert "3 of 20 frames" in first
    assert len(others) == 1
    warned = replace(FINE, warnings=("rows are off",))
    assert health_warnings([warned, FINE, warned, FINE]) == ["frames 0-2: rows are off"]


def test_what_follows_a_lost_pose_is_another_stretch_unless_that_was_skipped() -> None:
    assert stretches([FINE, SKIPPED, FINE, LOST, FINE, FINE]).tolist() == [0, -1, 0, -1, 1, 1]
    assert stretches([FINE, LOST, SKIPPED, FINE]).tolist() == [0, -1, -1, 1]
    assert stretches([]).tolist() == []


def test_one_line_says_what_is_doubted_of_a_drive() -> None:
    assert doubt_about([FINE] * 3) == []
    (line,) = doubt_about([*[FINE] * 20, SKIPPED, *[FINE] * 20])
    assert line == "1 of 41 poses are not to be trusted (frame 20): nothing of them is in the map"
    (line,) = doubt_about([*[FINE] * 20, LOST, *[FINE] * 20])
    assert line.endswith("and what follows may be misplaced")
    (line,) = doubt_about([FINE, LOST, FINE])
    assert line.startswith("PATH AND MAP ARE NOT TO BE TRUSTED: the poses of 1 of 3 frames")


def test_frames_are_named_by_their_first_three_stretches() -> None:
    assert name_frames([4]) == "frame 4"
    assert name_frames([1, 2, 5, 7, 8, 9]) == "frames 1-2, frame 5, frames 7-9"
    assert name_frames([1, 3, 5, 7]) == "frame 1, frame 3, frame 5, …"
