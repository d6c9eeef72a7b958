"""The path is corrected so that its loops close."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from recon.core.errors import RegistrationError
from recon.core.geometry import se3
from recon.core.values import Trajectory
from recon.places.closure import DrivePath, Tie, close_loops, join_drives
from recon.places.loop import Loop
from recon.places.places import Drift, drift_over, is_possible, path_lengths
from tests.places.conftest import INFORMATION, true_loop

LAP = 200


@pytest.fixture(scope="module")
def truth() -> Trajectory:
    """One and a tenth laps of a circle of 200 m, a metre per frame."""
    angle = 2 * np.pi * np.arange(LAP + 21) / LAP
    radius = LAP / (2 * np.pi)
    poses = np.stack(
        [
            se3.make_transform(
                se3.exp_so3(np.array([0.0, a, 0.0])),
                radius * np.array([1 - np.cos(a), 0.0, np.sin(a)]),
            )
            for a in angle
        ]
    )
    return Trajectory(poses, 0.1 * np.arange(len(poses)))


@pytest.fixture(scope="module")
def loops(truth) -> list[Loop]:
    return [true_loop(truth, k, LAP + k) for k in range(0, 20, 2)]


def _path_m(path: Trajectory) -> np.ndarray:
    return path_lengths(path.T_world_camera, np.ones(len(path), np.bool_))


def _close(odometry: Trajectory, loops: list[Loop]):
    return close_loops(odometry, _path_m(odometry), loops)


def _end_error_m(path: Trajectory, truth: Trajectory) -> float:
    return float(np.linalg.norm(path.positions_m[-1] - truth.positions_m[-1]))


def test_without_loops_the_path_is_the_very_same(odometry):
    closure = _close(odometry, [])

    assert closure.trajectory is odometry


def test_closing_removes_a_planted_drift(odometry, truth, loops):
    closure = _close(odometry, loops)

    assert _end_error_m(odometry, truth) > 2.0
    # What stays is the scale error of 1 % over the 20 m that the last loop hangs on.
    assert _end_error_m(closure.trajectory, truth) < 0.002 * truth.path_length_m
    assert len(closure.closed) == len(loops)


def test_the_whole_path_gets_better_not_just_its_end(odometry, truth, loops):
    def rms(path):
        return np.sqrt(np.mean((path.positions_m - truth.positions_m) ** 2))

    # One loop cannot tell where on the way the error arose; it spreads it evenly.
    assert rms(_close(odometry, loops).trajectory) < 0.5 * rms(odometry)


def test_a_false_loop_among_right_ones_is_refused(odometry, truth, loops):
    false = replace(true_loop(truth, 30, 34), last=120)
    closure = _close(odometry, [*loops[:5], false, *loops[5:]])

    assert closure.refused == (false,)
    assert _end_error_m(closure.trajectory, truth) < 0.002 * truth.path_length_m


def test_a_false_loop_alone_is_refused_whole(odometry, truth):
    false = replace(true_loop(truth, 30, 34), last=120)
    closure = _close(odometry, [false])

    assert closure.trajectory is odometry
    assert closure.refused == (false,)


def test_a_path_that_closes_already_stays_where_it_is():
    """There and back, to the very same numbers: every misfit is exactly 0."""
    poses = np.tile(np.eye(4), (41, 1, 1))
    poses[:, 2, 3] = 20.0 - np.abs(np.arange(41) - 20.0)
    path = Trajectory(poses, 0.1 * np.arange(41))
    closure = _close(path, [true_loop(path, k, 40 - k) for k in range(5)])

    assert len(closure.closed) == 5
    assert np.allclose(closure.trajectory.T_world_camera, poses, atol=1e-9)


def test_a_graph_without_a_solution_closes_nothing(odometry, loops, monkeypatch):
    def fails(*_: object) -> None:
        raise RegistrationError("the pose graph has no solution")

    monkeypatch.setattr("recon.places.closure.optimise_poses", fails)
    closure = _close(odometry, loops)
    assert closure.trajectory is odometry
    assert closure.refused == tuple(loops)


def test_steps_stay_smooth(odometry, loops):
    closed = _close(odometry, loops).trajectory
    steps = se3.invert(closed.T_world_camera[:-1]) @ closed.T_world_camera[1:]
    before = se3.invert(odometry.T_world_camera[:-1]) @ odometry.T_world_camera[1:]
    change = se3.invert(before) @ steps

    # 3.5 m of error, spread over 200 steps, is 2 cm a step.
    assert np.linalg.norm(change[:, :3, 3], axis=1).max() < 0.1
    assert np.degrees(se3.angle_rad(change)).max() < 0.3


def test_a_correction_moves_points_with_their_frame(odometry, loops):
    closure = _close(odometry, loops)
    point = np.array([[1.0, -2.0, 8.0]])
    seen = se3.apply(odometry.T_world_camera[150], point)

    moved = se3.apply(closure.correction(odometry, 150), seen)
    assert np.allclose(moved, se3.apply(closure.trajectory.T_world_camera[150], point), atol=1e-9)


def test_the_first_pose_stays(odometry, loops):
    assert np.array_equal(_close(odometry, loops).trajectory.T_world_camera[0], np.eye(4))


def test_a_long_drive_is_closed_with_few_nodes(odometry, truth, loops, monkeypatch):
    monkeypatch.setattr("recon.places.closure._MAX_NODES", 12)

    closure = _close(odometry, loops)
    assert _end_error_m(closure.trajectory, truth) < 0.005 * truth.path_length_m


def test_a_metre_without_measurement_counts_as_many():
    poses = np.tile(np.eye(4), (4, 1, 1))
    poses[:, 2, 3] = [0.0, 1.0, 2.0, 3.0]
    path_m = path_lengths(poses, np.array([True, True, False, True]))
    assert path_m.tolist() == [0.0, 1.0, 23.0, 24.0]


def test_drift_grows_with_the_path_and_bounds_what_is_possible():
    near, far = drift_over(50.0), drift_over(500.0)
    off = se3.make_transform(np.eye(3), np.array([5.0, 0.0, 0.0]))

    assert far.position_m > near.position_m
    assert is_possible(off, far, Drift(0.0, 1e-3))
    assert not is_possible(off, near, Drift(0.0, 1e-3))


@pytest.mark.parametrize("known", [(True, False), (True, True)])
def test_a_drive_with_known_poses_keeps_its_shape(truth, odometry, known):
    """Links are off by centimetres, which would bend what odometry measured."""
    noise = np.random.default_rng(0)
    away = se3.make_transform(np.eye(3), np.array([0.1, 0.0, 0.1]))
    paths = [
        truth if sure else replace(odometry, T_world_camera=away @ odometry.T_world_camera)
        for sure in known
    ]
    drives = [
        DrivePath(path, np.zeros(len(path)) if sure else _path_m(path))
        for path, sure in zip(paths, known, strict=True)
    ]
    off = noise.normal(0.0, [0.02] * 3 + [0.001] * 3, (12, 6))
    ties = [
        Tie((0, 1), Loop(20 * k, 20 * k, se3.as_transform(step), INFORMATION, 100, 1.0))
        for k, step in enumerate(off[: len(truth) // 20])
    ]

    joined = join_drives(drives, ties)

    assert joined is not None
    assert joined.kept.all()
    for path, sure, found in zip(paths, known, joined.trajectories, strict=True):
        moved = found.T_world_camera[0] @ se3.invert(path.T_world_camera[0])
        off_m = np.linalg.norm(moved @ path.T_world_camera - found.T_world_camera, axis=(1, 2))
        assert (off_m.max() < 1e-9) == sure
    apart_m = joined.trajectories[1].positions_m - truth.positions_m
    # Behind the last link only odometry says where the drive goes.
    assert np.linalg.norm(apart_m, axis=1)[: ties[-1].loop.last].max() < 0.1
