"""Loops vote: a loop with little support, or contradicted by others, has no effect."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from recon.core.geometry import se3
from recon.core.values import Trajectory
from recon.places.closure import close_loops
from recon.places.loop import Loop, agreeing_loops
from tests.places.conftest import drifted, true_loop

LAP = 200
HOUSE_M = 8
"""From one house to the next, alike one."""


def _circle(laps: float) -> Trajectory:
    """A metre per frame."""
    step = se3.make_transform(
        se3.exp_so3(np.array([0.0, 2 * np.pi / LAP, 0.0])), np.array([0.0, 0.0, 1.0])
    )
    poses = [np.eye(4)]
    for _ in range(int(laps * LAP)):
        poses.append(poses[-1] @ step)
    return Trajectory(np.stack(poses), 0.1 * np.arange(len(poses)))


@pytest.fixture(scope="module")
def truth() -> Trajectory:
    return _circle(1.2)


def _next_house(truth: Trajectory, first: int, last: int) -> Loop:
    """The house beside the right one is taken for it."""
    return replace(true_loop(truth, first, last), first=first + HOUSE_M)


def _agreeing(odometry: Trajectory, loops: list[Loop]) -> list[Loop]:
    poses = {
        frame: (odometry.T_world_camera[frame], float(odometry.distances_m[frame]))
        for loop in loops
        for frame in (loop.first, loop.last)
    }
    return agreeing_loops(loops, poses, poses)


def test_loops_that_tell_the_same_are_believed(odometry, truth):
    loops = [true_loop(truth, k, LAP + k) for k in range(0, 12, 2)]

    assert _agreeing(odometry, loops) == loops


def test_two_loops_are_too_few(odometry, truth):
    assert _agreeing(odometry, [true_loop(truth, k, LAP + k) for k in (0, 2)]) == []


def test_a_minority_of_alike_houses_is_outvoted(odometry, truth):
    right = [true_loop(truth, k, LAP + k) for k in range(0, 12, 2)]
    wrong = [_next_house(truth, k, LAP + k) for k in (1, 5, 9)]

    assert _agreeing(odometry, [*right, *wrong]) == right


def test_without_a_clear_majority_nobody_is_believed(odometry, truth):
    right = [true_loop(truth, k, LAP + k) for k in range(0, 12, 3)]
    wrong = [_next_house(truth, k, LAP + k) for k in range(1, 12, 3)]

    assert _agreeing(odometry, [*right, *wrong]) == []


def test_loops_to_several_laps_do_not_contradict_each_other():
    truth = _circle(2.2)
    odometry = drifted(truth, share=0.01, turn_deg_per_m=0.02)
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
    closure = close_loops(odometry, odometry.distances_m, believed)
    assert not set(map(id, wrong)) & set(map(id, closure.closed))
    before, after = (
        np.linalg.norm(path.positions_m - truth.positions_m, axis=1).max()
        for path in (odometry, closure.trajectory)
    )
    assert after < 0.7 * before
