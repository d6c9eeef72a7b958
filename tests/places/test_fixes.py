"""Positions measured along a drive take out its drift, and edges of a graph count by weight."""

from __future__ import annotations

import numpy as np
import pytest

from recon.core.errors import ShapeError
from recon.core.geometry.alignment import fit_points
from recon.core.geometry.se3 import angle_rad, apply, exp_so3, invert, log_so3, make_transform
from recon.core.values import Trajectory
from recon.places.closure import DrivePath, JoinedDrives, join_drives
from recon.places.fixes import NO_FIXES, Fixes, Held, PoseEdge, optimise_poses
from recon.places.places import path_lengths

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
    path_m = path_lengths(odometry.T_world_camera, np.ones(FRAMES, np.bool_))
    # About where the survey is: half a degree and a metre off.
    about = invert(T_SURVEY_WORLD) @ make_transform(exp_so3(np.full(3, 0.005)), np.ones(3))
    return join_drives([DrivePath(odometry, path_m)], [], Held(about, [fixes]))


def bend_m(path: Trajectory, truth: Trajectory) -> float:
    """Largest distance from the truth, moved rigidly to where it fits best."""
    moved = fit_points(path.positions_m, truth.positions_m).move(path)
    return float(np.linalg.norm(moved.positions_m - truth.positions_m, axis=1).max())


def test_a_path_runs_through_measured_positions(truth: Trajectory, odometry: Trajectory) -> None:
    found = held(odometry, measured(truth, 0.01))
    assert bend_m(odometry, truth) > 1.0
    assert bend_m(found.trajectories[0], truth) < 0.1
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


def _ahead(metres: float) -> np.ndarray:
    return make_transform(np.eye(3), np.array([0.0, 0.0, metres]))


def test_two_edges_meet_where_their_information_says():
    edges = [PoseEdge(0, 1, _ahead(k), w * np.eye(6)) for k, w in ((1.0, 3.0), (2.0, 1.0))]
    poses, _ = optimise_poses(np.stack([np.eye(4), _ahead(1.0)]), edges, 1.0)
    assert poses[1][:3, 3] == pytest.approx([0.0, 0.0, 1.25], abs=1e-4)
    assert np.array_equal(poses[0], np.eye(4))


@pytest.mark.parametrize("axis", range(6))
def test_information_counts_in_its_own_direction(axis):
    """One edge knows one direction well, the other one all directions equally."""
    step = np.zeros(6)
    step[axis] = 0.01
    moved = make_transform(exp_so3(step[3:]), step[:3])
    sure = np.ones(6)
    sure[axis] = 1e6
    edges = [PoseEdge(0, 1, moved, np.diag(sure)), PoseEdge(0, 1, np.eye(4), np.eye(6))]
    poses, _ = optimise_poses(np.stack([np.eye(4), np.eye(4)]), edges, 1.0)
    got = np.concatenate([poses[1][:3, 3], log_so3(poses[1][:3, :3])])
    assert got == pytest.approx(step, abs=1e-4)


@pytest.mark.parametrize("chi2", [4.0, 25.0, 400.0])
def test_a_doubtful_edge_of_that_misfit_counts_a_quarter(chi2):
    """The stiff edge holds the node 1 m from where the doubtful one wants it."""
    edges = [
        PoseEdge(0, 1, np.eye(4), 1e8 * np.eye(6)),
        PoseEdge(0, 1, _ahead(1.0), chi2 * np.eye(6), doubtful=True),
    ]
    _, weights = optimise_poses(np.stack([np.eye(4), np.eye(4)]), edges, chi2)
    assert weights[1] == pytest.approx(0.25, abs=0.01)
    assert weights[0] == 1.0


def test_an_edge_has_to_be_a_pose():
    with pytest.raises(ShapeError, match="T_first_last"):
        PoseEdge(0, 1, np.eye(3), np.eye(6))
