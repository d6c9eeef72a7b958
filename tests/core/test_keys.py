"""Sets of keys are those that numpy gives."""

from __future__ import annotations

import numpy as np
from hypothesis import given
from hypothesis import strategies as st
from hypothesis.extra import numpy as hnp

from recon.core.kernels.voxels import are_among, distinct_keys, find_keys

ANY = st.integers(-(2**62), 2**62) | st.integers(0, 9)
KEYS = hnp.arrays(np.int64, st.integers(0, 30), elements=ANY)


@given(KEYS)
def test_distinct_keys_are_sorted_and_each_there_once(keys: np.ndarray) -> None:
    np.testing.assert_array_equal(distinct_keys(keys), np.unique(keys))


@given(KEYS, KEYS)
def test_keys_are_found_where_they_are(wanted: np.ndarray, keys: np.ndarray) -> None:
    place, known = find_keys(wanted, np.sort(keys))
    np.testing.assert_array_equal(known, np.isin(wanted, keys))
    np.testing.assert_array_equal(np.sort(keys)[place[known]], wanted[known])
    np.testing.assert_array_equal(are_among(wanted, keys), known)
