"""Levenberg-Marquardt: the loop that every non-linear least-squares fit here shares.

Each fit brings its own cost, linearisation and step: some eliminate points or board poses
(Schur complement), one runs compiled.

Ref: Triggs et al. 2000, "Bundle adjustment: a modern synthesis", section 4.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import Generic, TypeVar

State = TypeVar("State")
Linear = TypeVar("Linear")

_MORE, _LESS = 10.0, 0.1  # factors of the damping after a step that fails or succeeds
_LEAST_DAMPING, _LARGEST_DAMPING = 1e-12, 1e12


@dataclass(frozen=True)
class Problem(Generic[State, Linear]):
    """What is fitted."""

    # gives the cost of a state; NaN or infinite where it is impossible
    cost: Callable[[State], float]
    linearise: Callable[[State], Linear]  # gives the normal equations at a state
    # gives the state after a step with so much damping; None = impossible
    step: Callable[[State, Linear, float], State | None]


def minimise(
    problem: Problem[State, Linear],
    start: State,
    *,
    rounds: int,
    min_gain: float,
    damping: float = 1e-3,
) -> State:
    """Minimise a cost, finite at ``start``, by damped Gauss-Newton steps that each must lower it.

    At most ``rounds`` steps are tried; one that gains less than ``min_gain`` of it is the last.
    ``damping`` is the first, relative to the diagonal of the normal equations.
    """
    state, lowest, linear = start, problem.cost(start), problem.linearise(start)
    for _ in range(rounds):
        trial = problem.step(state, linear, damping)
        trial_cost = float("inf") if trial is None else problem.cost(trial)
        if trial is None or not trial_cost < lowest:  # also where it is NaN
            damping *= _MORE
            if damping > _LARGEST_DAMPING:
                break
            continue
        gain = (lowest - trial_cost) / lowest
        state, lowest, damping = trial, trial_cost, max(damping * _LESS, _LEAST_DAMPING)
        if gain < min_gain:
            break
        linear = problem.linearise(state)
    return state
