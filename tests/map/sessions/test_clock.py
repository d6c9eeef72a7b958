"""The clock of positions is told from drift of the path, and as well as it says."""

import numpy as np
import pytest

from recon.core.values import Trajectory
from recon.core.values.arrays import Float64
from recon.map.sessions.clock import clock_error
from recon.places.places import SHARE, TURN_DEG

NOISE_M = 0.05
TIMES_S = 0.1 * np.arange(300)


def road(times_s: Float64) -> Float64:
    """Places (N, 3) along a road with a bend, on which the drive speeds up, and slows down."""
    along_m = 6.0 * times_s + 8.0 * np.sin(0.35 * times_s)
    turned = 0.8 / (1.0 + np.exp(-(along_m - 90.0) / 12.0))
    steps_m = np.diff(along_m, prepend=along_m[:1])
    plan = np.stack([steps_m * np.cos(turned), steps_m * np.sin(turned)], axis=1)
    return np.column_stack([np.cumsum(plan, axis=0), np.zeros(len(times_s))])


def speeding_up(times_s: Float64) -> Float64:
    return np.column_stack([5.0 * times_s + 0.15 * times_s**2, *np.zeros((2, len(times_s)))])


def steady(times_s: Float64) -> Float64:
    return np.column_stack([8.0 * times_s, *np.zeros((2, len(times_s)))])


def drifted(places_m: Float64, rng: np.random.Generator) -> Float64:
    """The path by an odometry that drifts: its scale as a whole, its heading at random."""
    steps_m = np.diff(places_m, axis=0, prepend=places_m[:1])
    length_m = np.linalg.norm(steps_m, axis=1)
    turn = np.cumsum(rng.normal(0.0, np.radians(TURN_DEG) * np.sqrt(length_m)))
    c, s, x, y = np.cos(turn), np.sin(turn), *steps_m.T[:2]
    steps_m = np.column_stack([c * x - s * y, s * x + c * y, steps_m[:, 2]])
    return (1.0 + rng.normal(0.0, SHARE)) * np.cumsum(steps_m, axis=0)


def found(path_m: Float64, true_m: Float64, late_s: float, seed: int) -> tuple[float, float]:
    """What is found of positions with noise, four a second, whose clock is late."""
    rng, at_s = np.random.default_rng(seed), np.arange(1.0, 29.0, 0.25)

    def along(places_m: Float64, times_s: Float64) -> Float64:
        return np.column_stack([np.interp(times_s, TIMES_S, axis) for axis in places_m.T])

    there_m = along(true_m, at_s) + rng.normal(0.0, NOISE_M, (len(at_s), 3)) + [4e5, 5e6, 100.0]
    rows = np.column_stack([at_s + late_s, there_m, np.full((len(at_s), 3), np.nan)])
    poses = np.tile(np.eye(4), (len(TIMES_S), 1, 1))
    poses[:, :3, 3] = path_m
    return clock_error(Trajectory(poses, TIMES_S), rows, lambda times_s: along(path_m, times_s))


@pytest.mark.parametrize("late_s", [0.0, 0.4])
def test_drift_is_no_clock_and_a_clock_is_as_far_off_as_it_says(late_s):
    true_m = road(TIMES_S)
    offsets = [
        found(drifted(true_m, np.random.default_rng(seed)), true_m, late_s, seed)
        for seed in range(16)
    ]
    if late_s == 0.0:
        assert offsets == 16 * [(0.0, 0.0)]
    else:
        off = [(time_s - late_s) / sigma_s for time_s, sigma_s in offsets if sigma_s]
        assert len(off) == 16
        # Of 16 samples, a standard deviation is known to 18 %.
        assert 0.5 < np.sqrt(np.mean(np.square(off))) < 1.5


@pytest.mark.parametrize("too_long", [0.99, 1.003, 1.02])
@pytest.mark.parametrize("place", [speeding_up, steady])
def test_a_road_that_comes_out_too_long_shows_no_clock(place, too_long):
    """While a drive speeds up evenly, a late clock makes the road longer, and little else."""
    true_m = place(TIMES_S)
    assert found(too_long * true_m, true_m, 0.0, 1) == (0.0, 0.0)
    late_s, sigma_s = found(too_long * true_m, true_m, 0.4, 1)
    if place is steady:
        assert sigma_s == 0.0
    else:
        assert late_s == pytest.approx(0.4, abs=3.0 * sigma_s)
        assert 0.0 < sigma_s < 0.1
