"""The loop of non-linear fits: it reaches the minimum, refuses what is worse, and ends."""

import math
from itertools import pairwise

import numpy as np
import pytest

from recon.core.geometry.alignment import Problem, minimise


def rosenbrock(state: np.ndarray) -> np.ndarray:
    x, y = state
    return np.array([10 * (y - x * x), 1 - x])


def problem(tried: list[float]) -> Problem:
    """Rosenbrock's valley, whose only minimum is (1, 1); notes the damping of each step."""

    def linearise(state: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        J = np.array([[-20 * state[0], 10.0], [-1.0, 0.0]])
        return J.T @ J, J.T @ rosenbrock(state)

    def step(state: np.ndarray, linear: tuple, damping: float) -> np.ndarray:
        tried.append(damping)
        H, g = linear
        return state - np.linalg.solve(H + damping * np.diag(np.diag(H)), g)

    return Problem(lambda state: float((rosenbrock(state) ** 2).sum()), linearise, step)


def test_the_minimum_at_the_end_of_a_bent_valley_is_reached():
    tried: list[float] = []
    found = minimise(problem(tried), np.array([-1.2, 1.0]), rounds=100, min_gain=1e-12)
    np.testing.assert_allclose(found, [1, 1], atol=1e-6)
    assert tried[0] == 1e-3
    # After a step that fails ten times as much, after one that succeeds a tenth.
    assert {round(math.log10(b / a)) for a, b in pairwise(tried)} == {-1, 1}


def test_a_step_that_gains_too_little_is_the_last():
    tried: list[float] = []
    flat = minimise(problem(tried), np.array([-1.2, 1.0]), rounds=100, min_gain=0.999)
    assert tried == pytest.approx([1e-3, 1e-2])  # the first is refused
    assert float((rosenbrock(flat) ** 2).sum()) < 24.2  # of the start


@pytest.mark.parametrize("worse", [None, math.nan, math.inf, 2.0, 1.0])
def test_where_no_step_is_better_the_start_stays_until_damping_is_out_of_bounds(worse):
    tried: list[float] = []

    def step(state: float, linear: None, damping: float) -> float | None:
        tried.append(damping)
        return None if worse is None else worse

    stuck = Problem(lambda state: state, lambda state: None, step)
    assert minimise(stuck, 1.0, rounds=100, min_gain=1e-3) == 1.0
    np.testing.assert_allclose(tried, 10.0 ** np.arange(-3, 13))
    assert minimise(stuck, 1.0, rounds=3, min_gain=1e-3, damping=1.0) == 1.0
    np.testing.assert_allclose(tried[-3:], [1, 10, 100])
