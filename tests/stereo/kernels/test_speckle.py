"""The compiled speckle search equals its reference, and knows what a region is."""

from __future__ import annotations

import math

import numpy as np
from hypothesis import given
from hypothesis import strategies as st
from hypothesis.extra import numpy as hnp

from recon.stereo.kernels.finish import find_speckles
from tests.stereo.kernels.speckle_reference import find_speckles_reference

maps = hnp.arrays(
    np.float32,
    st.tuples(st.integers(1, 8), st.integers(1, 8)),
    elements=st.one_of(st.sampled_from([0.0, 0.5, 1.0, 2.5, 4.0]), st.just(math.nan)),
)


@given(maps, st.sampled_from([0.5, 1.0, 2.0]), st.integers(0, 20))
def test_speckles_equal_those_of_the_reference(values: np.ndarray, step: float, size: int) -> None:
    found = find_speckles(values, step, size)
    np.testing.assert_array_equal(found, find_speckles_reference(values, step, size))


def test_region_of_the_smallest_size_stays() -> None:
    values = np.full((4, 6), np.nan, np.float32)
    values[1, 1:4] = 5.0
    assert not find_speckles(values, 1.0, 3).any()
    np.testing.assert_array_equal(find_speckles(values, 1.0, 4), np.isfinite(values))


def test_slope_of_small_steps_is_one_region() -> None:
    slope = np.tile(np.arange(50, dtype=np.float32), (1, 1))
    assert not find_speckles(slope, 1.0, 50).any()
    assert find_speckles(slope, 0.9, 2).all()


def test_corners_do_not_connect() -> None:
    values = np.array([[1, np.nan], [np.nan, 1]], np.float32)
    np.testing.assert_array_equal(find_speckles(values, 1.0, 2), np.isfinite(values))
