"""Loops vote, and the path is corrected so that those which are believed close."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from recon.core.errors import RegistrationError
from recon.core.geometry import se3
from recon.core.values import Trajectory
from recon.odometry.protocol import OdometryHealth
from recon.places.closure import Constraint, DrivePath, close_loops, join_drives
from recon.places.places import Drift, Loop, agreeing_loops, drift_over, is_possible, path_lengths
from tests.places.conftest import INFORMATION, drifted, drive_path, true_loop

LAP = 200


def circle(laps: float) -> Trajectory:
    """A circle of 200 m, a metre per frame."""
    turn = se3.exp_so3(np.array([0.0, 2 * np.pi / LAP, 0.0]))
    step = se3.make_transform(turn, np.array([0.0, 0.0, 1.0]))
    poses = [np.eye(4)]
    for _ in range(int(laps * LAP)):
        poses.append(poses[-1] @ step)
    return Trajectory(np.stack(poses), 0.1 * np.arange(len(poses)))


@pytest.fixture(scope="module")
def truth() -> Trajectory:
    return circle(1.12)


@pytest.fixture(scope="module")
def loops(truth) -> list[Loop]:
    return [true_loop(truth, k, LAP + k) for k in range(0, 20, 2)]


def _close(odometry: Trajectory, loops: list[Loop]):
    return close_loops(drive_path(odometry), loops)


def _end_error_m(path: Trajectory, truth: Trajectory) -> float:
    return float(np.linalg.norm(path.positions_m[-1] - truth.positions_m[-1]))


def test_closing_removes_a_planted_drift_all_along_the_path(odometry, truth, loops):
    assert _close(odometry, []).trajectory is odometry
    closure = _close(odometry, loops)
    assert _end_error_m(odometry, truth) > 2.0
    # What stays is the scale error of 1 % over the 20 m that the last loop hangs on.
    assert _end_error_m(closure.trajectory, truth) < 0.002 * truth.path_length_m
    assert len(closure.closed) == len(loops)
    assert np.array_equal(closure.trajectory.T_world_camera[0], np.eye(4))
    rms = [
        np.sqrt(np.mean((path.positions_m - truth.positions_m) ** 2))
        for path in (closure.trajectory, odometry)
    ]
    # One loop cannot tell where on the way the error arose; it spreads it evenly.
    assert rms[0] < 0.5 * rms[1]


def test_a_false_loop_is_refused_among_right_ones_and_alone(odometry, truth, loops):
    false = replace(true_loop(truth, 30, 34), last=120)
    closure = _close(odometry, [*loops[:5], false, *loops[5:]])
    assert closure.refused == (false,)
    assert _end_error_m(closure.trajectory, truth) < 0.002 * truth.path_length_m
    alone = _close(odometry, [false])
    assert alone.trajectory is odometry
    assert alone.refused == (false,)


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


def test_a_correction_moves_points_with_their_frame(odometry, loops):
    closure = _close(odometry, loops)
    point = np.array([[1.0, -2.0, 8.0]])
    seen = se3.apply(odometry.T_world_camera[150], point)
    moved = se3.apply(closure.correction(odometry, 150), seen)
    assert np.allclose(moved, se3.apply(closure.trajectory.T_world_camera[150], point), atol=1e-9)


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
        DrivePath.of(path, [OdometryHealth(ok=True, known=sure)] * len(path))
        for path, sure in zip(paths, known, strict=True)
    ]
    off = noise.normal(0.0, [0.02] * 3 + [0.001] * 3, (12, 6))
    constraints = [
        Constraint((0, 1), Loop(20 * k, 20 * k, se3.as_transform(step), INFORMATION, 100, 1.0))
        for k, step in enumerate(off[: len(truth) // 20])
    ]
    joined = join_drives(drives, constraints)
    assert joined.kept.all()
    for path, sure, found in zip(paths, known, joined.trajectories, strict=True):
        moved = found.T_world_camera[0] @ se3.invert(path.T_world_camera[0])
        off_m = np.linalg.norm(moved @ path.T_world_camera - found.T_world_camera, axis=(1, 2))
        assert (off_m.max() < 1e-9) == sure
    apart_m = joined.trajectories[1].positions_m - truth.positions_m
    # Behind the last link only odometry says where the drive goes.
    assert np.linalg.norm(apart_m, axis=1)[: constraints[-1].loop.last].max() < 0.1


@pytest.mark.parametrize("count", [2, 3])
def test_a_break_is_bridged_by_three_loops_and_by_no_fewer(truth, count):
    """At frame 150 odometry begins anew, elsewhere; at 210 once more, and nothing is seen again."""
    poses, begins = truth.T_world_camera.copy(), (150, 210)
    for frame in begins:
        poses[frame:] = se3.as_transform(np.array([30.0, 5.0, 0.0, 0.0, 1.0, 0.0])) @ poses[frame:]
    health = [OdometryHealth(begins=k in begins) for k in range(len(truth))]
    path = DrivePath.of(replace(truth, T_world_camera=poses), health)
    loops = tuple(true_loop(truth, k, LAP + k) for k in range(0, 3 * count, 3))
    closure = close_loops(path, loops)
    if count < 3:
        assert (closure.trajectory, closure.refused) == (path.trajectory, loops)
    else:
        off_m = np.linalg.norm(closure.trajectory.positions_m - truth.positions_m, axis=1)
        assert closure.closed == loops
        assert off_m[:210].max() < 0.01
        assert off_m[210:].min() > 10.0


HOUSE_M = 8  # from one house to the next, alike one


def _agreeing(odometry: Trajectory, loops: list[Loop]) -> list[Loop]:
    poses = {
        frame: (odometry.T_world_camera[frame], float(odometry.distances_m[frame]), 0)
        for loop in loops
        for frame in (loop.first, loop.last)
    }
    return agreeing_loops(loops, poses, poses)


def test_loops_that_tell_the_same_are_believed_if_there_are_three(odometry, truth):
    loops = [true_loop(truth, k, LAP + k) for k in range(0, 12, 2)]
    assert _agreeing(odometry, loops) == loops
    assert _agreeing(odometry, loops[:2]) == []


@pytest.mark.parametrize(
    ("right_ones", "wrong_ones", "believed"),
    [(range(0, 12, 2), (1, 5, 9), True), (range(0, 12, 3), range(1, 12, 3), False)],
)
def test_a_minority_of_alike_houses_is_outvoted_and_without_a_majority_nobody_is_believed(
    odometry, truth, right_ones, wrong_ones, believed
):
    right = [true_loop(truth, k, LAP + k) for k in right_ones]
    # The house beside the right one is taken for it.
    wrong = [replace(true_loop(truth, k, LAP + k), first=k + HOUSE_M) for k in wrong_ones]
    assert _agreeing(odometry, [*right, *wrong]) == (right if believed else [])


def test_loops_to_several_laps_do_not_contradict_each_other():
    truth = circle(2.2)
    odometry = drifted(truth, ratio=0.01, turn_deg_per_m=0.02)
    loops = [true_loop(truth, k + LAP * (k % 2), 2 * LAP + k) for k in range(12)]
    assert _agreeing(odometry, loops) == loops


@pytest.mark.parametrize("seed", range(10))
def test_loops_to_anywhere_bend_nothing(odometry, truth, seed):
    """A third as many false loops as right ones, to random places."""
    rng = np.random.default_rng(seed)
    right = [true_loop(truth, k, LAP + k) for k in range(0, 24, 2)]
    wrong = [
        replace(
            true_loop(truth, int(first), LAP + k), first=int(first + rng.integers(HOUSE_M, 120))
        )
        for k, first in zip(range(1, 24, 6), rng.integers(0, 24, 4), strict=True)
    ]
    believed = _agreeing(odometry, [*right, *wrong])
    closure = _close(odometry, believed)
    assert not set(map(id, wrong)) & set(map(id, closure.closed))
    before, after = (
        np.linalg.norm(path.positions_m - truth.positions_m, axis=1).max()
        for path in (odometry, closure.trajectory)
    )
    assert after < 0.7 * before
