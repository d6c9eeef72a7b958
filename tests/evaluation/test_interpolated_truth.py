"""Interpolated stretches of a true path are found, and nothing else is taken for one."""

from __future__ import annotations

import numpy as np
import pytest

from recon.core.geometry.se3 import exp_so3, make_transform
from recon.core.values import Trajectory
from recon.evaluation.segments import choose_segments, interpolated_poses, interpolation_warnings


def path(turns_deg: np.ndarray) -> Trajectory:
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


def test_an_interpolated_stretch_is_found_with_the_poses_at_its_ends() -> None:
    turns = measured(50)
    turns[:11] = [0.01, -0.04, -0.04]
    found = interpolated_poses(path(turns))
    assert np.flatnonzero(found).tolist() == list(range(12))


def test_the_warning_counts_the_segments_that_rest_on_it() -> None:
    turns = measured(50)
    turns[:11] = [0.01, -0.04, -0.04]
    truth = path(turns)
    segments = choose_segments(truth.distances_m)
    assert len(segments.first) == 9
    (warning,) = interpolation_warnings(truth, segments)
    assert warning.startswith("12 true poses (between 0 and 11) turn evenly")
    assert warning.endswith("9 of 9 segments begin or end there")


@pytest.mark.parametrize("seed", range(5))
def test_a_measured_path_has_none(seed: int) -> None:
    assert not interpolated_poses(path(measured(200, seed))).any()


def test_a_short_even_stretch_may_be_chance() -> None:
    turns = measured(50)
    turns[10:14] = turns[10]
    assert not interpolated_poses(path(turns)).any()


@pytest.mark.parametrize("turn_deg", [0.0, 0.5])
def test_a_path_that_turns_evenly_throughout_has_none(turn_deg: float) -> None:
    assert not interpolated_poses(path(np.full((60, 3), turn_deg))).any()


@pytest.mark.parametrize("poses", [1, 2, 6])
def test_a_path_of_few_poses_has_none(poses: int) -> None:
    assert not interpolated_poses(path(measured(poses - 1))).any()
