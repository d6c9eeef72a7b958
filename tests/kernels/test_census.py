"""The census: darker neighbours, bit by bit."""

from __future__ import annotations

import numpy as np
from hypothesis import given, settings
from hypothesis import strategies as st
from hypothesis.extra import numpy as hnp
from numpy.typing import NDArray

from recon.kernels.census import census_planes, census_planes_reference

greys = hnp.arrays(np.uint8, hnp.array_shapes(min_dims=2, max_dims=2, max_side=12))


@settings(deadline=None)  # the first call compiles
@given(greys, st.integers(0, 4), st.integers(0, 4))
def test_census_equals_its_twin(grey: NDArray[np.uint8], rows: int, columns: int) -> None:
    found = census_planes(grey, rows, columns)
    np.testing.assert_array_equal(found, census_planes_reference(grey, rows, columns))


def test_census_of_one_bright_pixel_has_all_bits_there_and_none_elsewhere() -> None:
    grey = np.zeros((5, 5), np.uint8)
    grey[2, 2] = 9
    bits = np.unpackbits(census_planes(grey, 1, 1), axis=0).sum(axis=0)
    assert bits[2, 2] == 8
    assert bits.sum() == 8


def test_census_does_not_change_with_brightness_and_contrast() -> None:
    grey = np.random.default_rng(0).integers(0, 100, (20, 30), dtype=np.uint8)
    brighter = (2 * grey + 40).astype(np.uint8)
    np.testing.assert_array_equal(census_planes(grey, 2, 2), census_planes(brighter, 2, 2))
