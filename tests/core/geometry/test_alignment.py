"""Aligning two paths recovers the motion between them."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from recon.core.geometry.alignment import Similarity, find_agreeing, fit_paths, fit_points
from recon.core.geometry.se3 import angle_rad, exp_so3, invert, make_transform
from recon.core.values import Trajectory

WORDS = st.tuples(*[st.floats(-2.0, 2.0) for _ in range(3)])


def points(seed: int, n: int = 40) -> np.ndarray:
    return np.random.default_rng(seed).normal(0, 5, (n, 3))


@given(turn=WORDS, move=WORDS, scale=st.floats(0.2, 5.0))
def test_the_similarity_that_moved_points_is_found(
    turn: tuple[float, ...], move: tuple[float, ...], scale: float
) -> None:
    T = make_transform(exp_so3(np.array(turn)), np.array(move))
    there = scale * points(1) @ T[:3, :3].T + T[:3, 3]
    found = fit_points(points(1), there, scaled=True)
    np.testing.assert_allclose(found.T_to_from, T, atol=1e-9)
    assert found.scale == pytest.approx(scale, rel=1e-9)


def test_a_rigid_fit_keeps_the_size() -> None:
    assert fit_points(points(2), 2 * points(2)).scale == 1.0


def test_points_in_one_place_are_moved_and_not_scaled() -> None:
    here, there = np.ones((5, 3)), np.full((5, 3), 3.0)
    found = fit_points(here, there, scaled=True)
    assert found.scale == 1.0
    np.testing.assert_allclose(found.T_to_from[:3, :3] @ here[0] + found.T_to_from[:3, 3], there[0])


def test_a_straight_path_is_not_left_turned_about_itself() -> None:
    poses = np.tile(np.eye(4), (30, 1, 1))
    poses[:, 2, 3] = np.arange(30)
    T = make_transform(exp_so3(np.array([0.1, 0.2, 1.0])), np.array([4.0, 5.0, 6.0]))
    truth = Trajectory(poses, np.arange(30.0))
    found = fit_paths(Trajectory(T @ poses, np.arange(30.0)), truth)
    assert angle_rad(found.T_to_from @ T) < 1e-9


def test_places_decide_more_the_wider_a_path_winds() -> None:
    turns = []
    for reach_m in (1.0, 30.0, 1000.0):
        poses = np.tile(np.eye(4), (60, 1, 1))
        poses[:, :3, 3] = np.random.default_rng(4).normal(0, reach_m, (60, 3))
        tilted = poses.copy()
        tilted[:, :3, :3] = exp_so3(np.array([0.02, 0.0, 0.0]))
        times = np.arange(60.0)
        found = fit_paths(Trajectory(tilted, times), Trajectory(poses, times))
        turns.append(float(angle_rad(found.T_to_from)))
    assert 0.019 < turns[0] < 0.02
    assert turns[0] > turns[1] > turns[2]
    assert turns[2] < 0.02 / 100


def test_a_path_is_moved_with_its_size() -> None:
    poses = np.tile(np.eye(4), (3, 1, 1))
    poses[:, 0, 3] = [0, 1, 2]
    T = make_transform(exp_so3(np.array([0.0, 0.0, np.pi / 2])), np.zeros(3))
    moved = Similarity(T, 3.0).move(Trajectory(poses, np.arange(3.0)))
    np.testing.assert_allclose(moved.positions_m[:, 1], [0, 3, 6], atol=1e-12)
    np.testing.assert_allclose(
        moved.T_world_camera[1, :3, :3], invert(invert(T))[:3, :3], atol=1e-12
    )


@pytest.mark.parametrize("wrong", [0, 1, 17])
def test_points_that_contradict_more_than_half_are_found(wrong: int) -> None:
    random = np.random.default_rng(8)
    along = np.column_stack([np.arange(40.0), np.zeros((40, 2))])  # straight: the hardest case
    T = make_transform(exp_so3(np.array([0.0, 0.0, 2.0])), np.array([5e5, 5e6, 100.0]))
    there = along @ T[:3, :3].T + T[:3, 3] + random.normal(0, 0.02, (40, 3))
    bad = random.permutation(40)[:wrong]
    there[bad] += random.choice([-1, 1], (wrong, 3)) * random.uniform(2, 50, (wrong, 3))
    np.testing.assert_array_equal(np.flatnonzero(~find_agreeing(along, there, 0.4)), np.sort(bad))


def test_three_points_cannot_outvote_one_another() -> None:
    assert find_agreeing(points(1, 3), points(2, 3), 0.1).all()
