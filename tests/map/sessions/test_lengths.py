"""Drives of two rigs, one of which has the wrong baseline, do not agree about lengths."""

from __future__ import annotations

import numpy as np
import pytest

from recon.core.geometry.se3 import exp_so3, invert, make_transform
from recon.core.values import Trajectory
from recon.map.sessions.joining import times_as_long
from recon.places.loop import Loop

T_THERE = make_transform(exp_so3(np.array([0.0, 2.5, 0.0])), np.array([30.0, 1.0, -80.0]))


def bend(longer: float) -> Trajectory:
    """A drive of 40 frames around a bend, as long as a rig measures it."""
    turns = 0.04 * np.arange(40)
    poses = [
        make_transform(
            exp_so3(np.array([0.0, turn, 0.0])),
            longer * 20.0 * np.array([1.0 - np.cos(turn), 0.0, np.sin(turn)]),
        )
        for turn in turns
    ]
    return Trajectory(np.stack(poses), 0.1 * np.arange(40))


def links_of(frames: range, noise_m: float = 0.02) -> list[Loop]:
    """Places that both saw, a frame apart: the link is measured by the first rig."""
    path, random = bend(1.0).T_world_camera, np.random.default_rng(5)
    found = []
    for frame in frames:
        T = invert(path[frame]) @ path[frame + 1]
        T[:3, 3] += random.normal(0.0, noise_m, 3)
        found.append(Loop(frame, frame + 1, T, np.eye(6), 100, 0.9))
    return found


@pytest.mark.parametrize("longer", [0.9, 1.0, 1.03])
def test_the_ratio_of_two_rigs_is_found_within_its_deviation(longer: float) -> None:
    other = bend(longer)
    moved = Trajectory(T_THERE @ other.T_world_camera, other.timestamps_s)
    found = times_as_long(bend(1.0), moved, links_of(range(0, 39, 3)))
    assert found is not None
    scale, sigma = found
    assert 0.0002 < sigma < 0.002
    assert abs(scale - 1.0 / longer) < 4 * sigma


def test_noisy_links_say_little_and_how_little() -> None:
    found = times_as_long(bend(1.0), bend(1.0), links_of(range(0, 39, 3), noise_m=0.5))
    assert found is not None
    assert 0.01 < found[1] < 0.05
    assert abs(found[0] - 1.0) < 4 * found[1]


def test_few_links_say_nothing() -> None:
    assert times_as_long(bend(1.0), bend(1.03), links_of(range(0, 39, 10))) is None


def test_links_at_one_place_say_nothing() -> None:
    still = Trajectory(np.tile(np.eye(4), (40, 1, 1)), 0.1 * np.arange(40))
    assert times_as_long(bend(1.0), still, links_of(range(0, 39, 3))) is None
