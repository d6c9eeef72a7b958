"""The compiled average of opposite neighbours equals its reference, and leaves surfaces alone."""

from __future__ import annotations

import math

import numpy as np
from hypothesis import given
from hypothesis import strategies as st
from hypothesis.extra import numpy as hnp
from numpy.typing import NDArray

from recon.stereo.kernels.finish import average_opposite
from tests.stereo.kernels.opposite_reference import average_opposite_reference

maps = hnp.arrays(
    np.float32,
    st.tuples(st.integers(1, 9), st.integers(1, 9)),
    elements=st.one_of(st.floats(0, 3, width=16), st.just(math.nan)),
)


def average(
    values: NDArray[np.float32], radius: int = 3, largest_step: float = 1.0
) -> NDArray[np.float32]:
    """All rows, in two strips."""
    averages, middle = np.full_like(values, -1.0), len(values) // 2
    for first, end in ((0, middle), (middle, len(values))):
        average_opposite(values, radius, largest_step, first, end, averages)
    return averages


@given(maps, st.integers(0, 4), st.sampled_from([0.25, 1.0, 5.0]))
def test_averages_equal_those_of_the_reference(
    values: NDArray[np.float32], radius: int, step: float
) -> None:
    expected = average_opposite_reference(values, radius, step)
    # float32: up to 40 pairs, each added up and added on, and a division, of values up to 3.
    rounding = 42 * 2.0**-24 * 3
    np.testing.assert_allclose(average(values, radius, step), expected, rtol=0, atol=rounding)


@given(
    st.floats(-0.3, 0.3),
    st.floats(-0.3, 0.3),
    hnp.arrays(np.bool_, (12, 14), elements=st.booleans()),
)
def test_slope_with_holes_stays_as_it_is(across: float, down: float, holes: np.ndarray) -> None:
    y, x = np.mgrid[:12, :14]
    slope = (20 + across * x + down * y).astype(np.float32)
    slope[holes] = np.nan
    # float32 values below 28: the slope's own rounding, and 24 pairs added up.
    rounding = (2 + 26) * 2.0**-24 * 28
    np.testing.assert_allclose(average(slope, largest_step=5.0), slope, rtol=0, atol=rounding)


def test_step_of_depth_stays_sharp() -> None:
    step = np.repeat(np.float32([10, 20]), 8)[None].repeat(9, axis=0)
    np.testing.assert_array_equal(average(step), step)


def test_noise_shrinks_by_the_root_of_the_number_of_pixels() -> None:
    noise = np.random.default_rng(1).normal(30, 0.1, (60, 80)).astype(np.float32)
    inner = (slice(3, -3), slice(3, -3))
    pixels = 25  # of a chessboard of 7 by 7
    assert average(noise)[inner].std() < 1.2 * 0.1 / math.sqrt(pixels)
    assert average(noise).std() < noise.std() / 4


def test_pixel_without_a_value_gets_none() -> None:
    values = np.full((7, 7), 5, np.float32)
    values[3, 3] = np.nan
    assert np.isnan(average(values)[3, 3])
    assert np.isfinite(average(values)).sum() == 48
