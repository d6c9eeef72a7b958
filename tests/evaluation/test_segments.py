"""Which poses are compared: associated by time, and none that were interpolated unsaid."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from recon.core.errors import EvaluationError
from recon.core.geometry.alignment import nearest_sorted
from recon.core.geometry.se3 import exp_so3, make_transform
from recon.core.values import Trajectory
from recon.evaluation.trajectory import (
    associate,
    choose_segments,
    interpolated_poses,
    interpolation_warnings,
    segments_of,
)

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


def turning_path(turns_deg: np.ndarray) -> Trajectory:
    """A drive of 1.2 m from frame to frame, with a rotation vector (N, 3) for each of them."""
    poses = [np.eye(4)]
    for turn in np.radians(turns_deg):
        poses.append(poses[-1] @ make_transform(exp_so3(turn), np.array([0.0, 0.0, 1.2])))
    # As many digits as a KITTI file has.
    rounded = np.array([float(f"{x:e}") for x in np.stack(poses).ravel()]).reshape(-1, 4, 4)
    return Trajectory(rounded, 0.1 * np.arange(len(poses)))


def measured(frames: int, seed: int = 0) -> np.ndarray:
    """Turns (N, 3) that change by a few hundredths of a degree from frame to frame."""
    return np.random.default_rng(seed).normal(0.0, 0.03, (frames, 3))


def test_an_interpolated_stretch_is_found_and_the_segments_that_rest_on_it_counted() -> None:
    turns = measured(50)
    turns[:11] = [0.01, -0.04, -0.04]
    truth = turning_path(turns)
    assert np.flatnonzero(interpolated_poses(truth)).tolist() == list(range(12))
    segments = choose_segments(truth.distances_m)
    assert len(segments.first) == 9
    (warning,) = interpolation_warnings(truth, segments)
    assert warning.startswith("12 true poses (between 0 and 11) turn evenly")
    assert warning.endswith("9 of 9 segments begin or end there")


SHORT_STRETCH = measured(50)
SHORT_STRETCH[10:14] = SHORT_STRETCH[10]


@pytest.mark.parametrize(
    "turns",
    [
        *(measured(200, seed) for seed in range(5)),
        SHORT_STRETCH,  # may be chance
        *(np.full((60, 3), turn_deg) for turn_deg in (0.0, 0.5)),  # even throughout
        *(measured(steps) for steps in (0, 1, 5)),
    ],
)
def test_no_other_path_has_interpolated_poses(turns: np.ndarray) -> None:
    assert not interpolated_poses(turning_path(turns)).any()
    assert interpolation_warnings(turning_path(turns), segments_of(np.arange(9.0), (3.0,), 1)) == []
