"""Positions measured along a drive take out its drift, and edges of a graph count by weight."""

from __future__ import annotations

import numpy as np
import pytest

from recon.core.geometry.alignment import fit_points
from recon.core.geometry.se3 import angle_rad, apply, exp_so3, invert, make_transform
from recon.core.values import Trajectory
from recon.places.closure import JoinedDrives, join_drives
from recon.places.pose_graph import NO_FIXES, Fixes, Held
from tests.places.conftest import drive_path

T_SURVEY_WORLD = make_transform(exp_so3(np.array([0.1, 2.0, -0.3])), np.array([30.0, -8.0, 5.0]))
ANTENNA_M = np.array([0.5, -1.2, -0.4])
FRAMES = 200


@pytest.fixture(scope="module")
def truth() -> Trajectory:
    """Half a circle and back the other way, a metre per frame."""
    angle = np.concatenate([np.linspace(0, 2, FRAMES // 2), np.linspace(2, 0, FRAMES // 2)])
    poses, T = [], np.eye(4)
    for turn in np.diff(angle, prepend=0.0):
        T = T @ make_transform(exp_so3(np.array([0.0, turn, 0.0])), np.array([0.0, 0.0, 1.0]))
        poses.append(T)
    return Trajectory(np.stack(poses), 0.1 * np.arange(FRAMES))


def measured(truth: Trajectory, sigma_m: float, every: int = 5) -> Fixes:
    frames = np.arange(0, FRAMES, every, dtype=np.int32)
    offset_m = np.tile(ANTENNA_M, (len(frames), 1))
    exact = Fixes(frames, offset_m, np.zeros((len(frames), 3)), sigma_m).by_path(truth)
    noise = np.random.default_rng(3).normal(0.0, sigma_m, exact.shape)
    return Fixes(frames, offset_m, apply(T_SURVEY_WORLD, exact) + noise, sigma_m)


def held(odometry: Trajectory, fixes: Fixes) -> JoinedDrives | None:
    # About where the survey is: half a degree and a metre off.
    about = invert(T_SURVEY_WORLD) @ make_transform(exp_so3(np.full(3, 0.005)), np.ones(3))
    return join_drives([drive_path(odometry)], [], Held(about, [fixes]))


def median_m(path: Trajectory, truth: Trajectory) -> float:
    """Largest distance from the truth, moved rigidly to where it fits best."""
    moved = fit_points(path.positions_m, truth.positions_m).move(path)
    return float(np.linalg.norm(moved.positions_m - truth.positions_m, axis=1).max())


def test_a_path_runs_through_measured_positions(truth: Trajectory, odometry: Trajectory) -> None:
    found = held(odometry, measured(truth, 0.01))
    assert median_m(odometry, truth) > 1.0
    assert median_m(found.trajectories[0], truth) < 0.1
    first = found.trajectories[0].T_world_camera[0]
    np.testing.assert_array_equal(first, odometry.T_world_camera[0])


def test_rough_positions_leave_a_smooth_path_smooth(truth: Trajectory) -> None:
    found = held(truth, measured(truth, 1.0))
    paths = (truth.T_world_camera, found.trajectories[0].T_world_camera)
    before, after = (invert(T[:-1]) @ T[1:] for T in paths)
    off = invert(before) @ after
    # Positions are off by a metre every five metres; what they bend is 1 % and a tenth of a degree.
    assert np.linalg.norm(off[:, :3, 3], axis=1).max() < 0.01
    assert np.degrees(angle_rad(off)).max() < 0.1


def test_positions_that_no_drift_explains_are_not_believed(truth: Trajectory) -> None:
    fixes = measured(truth, 0.01)
    zigzag = fixes.position_m + 8.0 * (np.arange(len(fixes)) % 2)[:, None]
    wrong = Fixes(fixes.frames, fixes.offset_m, zigzag, 0.01)
    assert held(truth, wrong) is None


def test_a_drive_without_positions_is_held_by_nothing(truth: Trajectory) -> None:
    T_world_node = np.tile(np.eye(4), (4, 1, 1))
    assert Held(np.eye(4), [NO_FIXES]).edges([truth], [np.arange(3)], T_world_node) == []
