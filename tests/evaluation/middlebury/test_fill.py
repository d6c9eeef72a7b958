"""Holes are filled with the background beside them."""

from __future__ import annotations

import math

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from recon.core.errors import ShapeError
from recon.evaluation.middlebury.score import fill_holes

N = float("nan")


def test_a_row_without_values_is_filled_from_the_nearest_row_the_upper_one_first() -> None:
    rows = [[N, N], [1, N], [N, N], [N, 2], [N, N], [N, N]]
    filled = fill_holes(np.array(rows, np.float32))
    assert filled[:, 0].tolist() == [1, 1, 1, 2, 2, 2]


def test_a_map_without_values_stays_without_and_another_dtype_is_refused() -> None:
    assert np.isnan(fill_holes(np.full((2, 2), N, np.float32))).all()
    with pytest.raises(ShapeError, match="values"):
        fill_holes(np.zeros((2, 2)))


def plainly_filled(row: list[float]) -> list[float]:
    """The rule for one row, pixel by pixel: the smaller of both neighbours, or the only one."""
    out = []
    for x, value in enumerate(row):
        left = next((v for v in row[:x][::-1] if not math.isnan(v)), None)
        right = next((v for v in row[x + 1 :] if not math.isnan(v)), None)
        beside = [v for v in (left, right) if v is not None]
        out.append(min(beside) if math.isnan(value) else value)
    return out


@given(st.integers(0, 2**16), st.integers(1, 12))
def test_known_values_stay_and_holes_follow_the_rule(seed: int, width: int) -> None:
    rng = np.random.default_rng(seed)
    values = rng.integers(0, 50, (5, width)).astype(np.float32)
    values[rng.random(values.shape) < 0.6] = np.nan
    values[:, rng.integers(width)] = 7
    expected = [plainly_filled(row) for row in values.tolist()]
    assert fill_holes(values).tolist() == expected
