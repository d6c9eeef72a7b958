from __future__ import annotations

import math

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from recon.core.geometry.se3 import exp_so3, log_so3

DIRECTIONS = st.lists(st.floats(-1, 1), min_size=3, max_size=3).filter(
    lambda v: float(np.linalg.norm(v)) > 0.1
)


@given(direction=DIRECTIONS, angle=st.floats(0.0, math.pi - 1e-6))
def test_log_is_the_inverse_of_exp(direction: list[float], angle: float) -> None:
    w = angle * np.array(direction) / np.linalg.norm(direction)
    # 1e-7: near π the rotation vector amplifies the matrix's rounding by its square root.
    np.testing.assert_allclose(log_so3(exp_so3(w)), w, atol=1e-7)


@pytest.mark.parametrize("axis", np.eye(3))
def test_half_a_turn_has_an_axis(axis: np.ndarray) -> None:
    R = 2.0 * np.outer(axis, axis) - np.eye(3)
    w = log_so3(R)
    assert np.linalg.norm(w) == pytest.approx(math.pi)
    np.testing.assert_allclose(exp_so3(w), R, atol=1e-12)
