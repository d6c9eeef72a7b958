"""Poses of two trajectories are associated by time."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from recon.core.errors import EvaluationError
from recon.core.geometry.alignment import nearest_sorted
from recon.core.values import Trajectory
from recon.evaluation.segments import associate

TIMES = st.lists(st.floats(0, 100), min_size=1, max_size=30).map(np.sort)


def path(times_s: np.ndarray) -> Trajectory:
    poses = np.tile(np.eye(4), (len(times_s), 1, 1))
    poses[:, 0, 3] = times_s
    return Trajectory(poses, times_s)


@given(times=TIMES, others=TIMES)
def test_the_nearest_time_is_no_farther_than_any(times: np.ndarray, others: np.ndarray) -> None:
    apart = np.abs(times[:, None] - others[None])
    found = nearest_sorted(times, others)
    np.testing.assert_array_equal(apart[np.arange(len(times)), found], apart.min(axis=1))


@given(times=TIMES, others=TIMES, tolerance=st.floats(0, 5))
def test_partners_are_near_in_order_and_belong_to_one_only(
    times: np.ndarray, others: np.ndarray, tolerance: float
) -> None:
    times, others = np.unique(times), np.unique(others)
    try:
        first, second = associate(path(times), path(others), tolerance)
    except EvaluationError:
        assert np.abs(times[:, None] - others[None]).min() > tolerance
        return
    assert (np.abs(first.timestamps_s - second.timestamps_s) <= tolerance).all()
    for found in (first, second):
        assert (np.diff(found.timestamps_s) > 0).all()
        np.testing.assert_array_equal(found.positions_m[:, 0], found.timestamps_s)


def test_a_slow_path_meets_every_third_pose_of_a_fast_one() -> None:
    slow, fast = associate(path(np.arange(10.0)), path(np.arange(30) / 3 + 0.002), 0.01)
    assert len(slow) == 10
    np.testing.assert_allclose(fast.timestamps_s, slow.timestamps_s + 0.002)


def test_clocks_that_never_meet_are_reported() -> None:
    with pytest.raises(EvaluationError, match=r"times 0\.000 to 4\.000 s and 1000\.000"):
        associate(path(np.arange(5.0)), path(1000 + np.arange(5.0)), 0.01)
