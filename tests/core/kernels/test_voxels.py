"""The voxel hash and its sums agree with a dictionary."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from hypothesis.extra import numpy as hnp

from recon.core.kernels import voxels
from recon.core.kernels.voxels import are_among, distinct_keys, find_keys
from tests.core.kernels.voxels_reference import sum_points_reference

# float32 sums of n ≤ 240 terms err by n · 2^-24 of the sum of their sizes: 1.4e-5 of the sum where
# all have one sign (values, weights; information takes two operations a term). Offsets from the
# middle of a cell (half of it, times weights up to 5) cancel: 240 · 2^-24 · (240 · 5 / 2) = 8.6e-3.
SUM_ROUNDING = {"rtol": 3e-5, "atol": 1e-2}


def _random_frame(rng: np.random.Generator, number: int) -> tuple[np.ndarray, ...]:
    xyz = rng.uniform(-3, 3, (number, 3)).astype(np.float32)
    weights = np.where(rng.random(number) < 0.1, 0, rng.uniform(0.1, 5, number))
    values = rng.uniform(-1, 255, (number, 2))
    return xyz, weights.astype(np.float32), values.astype(np.float32)


def _sum(frames: list[tuple[np.ndarray, ...]], edge: float) -> voxels.VoxelSums:
    sums = voxels.make_sums(1, 2)
    for number, frame in enumerate(frames):
        points = voxels.VoxelPoints(*frame)
        sums = voxels.add_points(sums, points, edge, number)
    return sums


@settings(max_examples=40)
@given(
    seed=st.integers(0, 2**32 - 1),
    sizes=st.lists(st.integers(0, 60), min_size=1, max_size=4),
    edge=st.sampled_from([0.1, 0.5, 1.0, 7.0]),
)
def test_sums_equal_those_of_the_reference(seed: int, sizes: list[int], edge: float) -> None:
    rng = np.random.default_rng(seed)
    frames = [_random_frame(rng, size) for size in sizes]
    _check(_sum(frames, edge), frames, edge)


def _check(sums: voxels.VoxelSums, frames: list[tuple[np.ndarray, ...]], edge: float) -> None:
    expected = sum_points_reference([(xyz.astype(np.float64), w, v) for xyz, w, v in frames], edge)
    cells = [tuple(cell) for cell in voxels.unpack_keys(sums.keys[: sums.used[0]]).tolist()]
    assert cells == list(expected)
    for row, cell in enumerate(cells):
        np.testing.assert_allclose(sums.sums[row], expected[cell]["sums"], **SUM_ROUNDING)
        assert sums.information[row] == pytest.approx(expected[cell]["information"], rel=3e-5)
        assert sums.frames[row] == expected[cell]["frames"]


@given(
    st.lists(
        st.tuples(*[st.integers(-voxels.KEY_LIMIT, voxels.KEY_LIMIT - 1)] * 3),
        min_size=1,
        max_size=20,
    )
)
def test_unpacking_inverts_packing(cells: list[tuple[int, int, int]]) -> None:
    keys = np.array([voxels.pack_key(*cell) for cell in cells], np.int64)
    assert (keys >= 0).all()
    assert voxels.unpack_keys(keys).tolist() == [list(cell) for cell in cells]


def test_growing_keeps_every_row() -> None:
    cells = np.stack(np.unravel_index(np.arange(8000), (20, 20, 20)), axis=1)
    keys = np.array([voxels.pack_key(*cell) for cell in cells.tolist()], np.int64)
    sums = voxels.make_sums(len(keys), 0)
    sums.keys[:] = keys
    sums.used[0] = len(keys)
    sums = voxels.reserve_sums(sums, len(keys) + 1)
    assert len(sums.table) >= 2 * len(sums.keys) >= 4 * len(keys)
    rows = [voxels.find_or_add(sums.table, key, -7) for key in keys.tolist()]
    assert rows == list(range(len(keys)))


def test_rows_with_room_are_not_copied() -> None:
    sums = voxels.make_sums(100, 2)
    assert voxels.reserve_sums(sums, 100) is sums


def test_neighbouring_cells_spread_over_the_table() -> None:
    # A street is a sheet of neighbouring cells: probing stays short if they do not cluster.
    cells = np.stack(np.unravel_index(np.arange(90_000), (300, 300, 1)), axis=1)
    keys = np.array([voxels.pack_key(*cell) for cell in cells.tolist()], np.int64)
    table = voxels.make_table(len(keys))
    voxels.enter_keys(table, keys)
    empty = np.flatnonzero(table[:, 0] == voxels.EMPTY)
    # At half load a random hash gives a longest run of some tens; clusters give thousands.
    assert np.diff(empty).max() < 200


@settings(max_examples=40)
@given(seed=st.integers(0, 2**32 - 1), sizes=st.lists(st.integers(0, 60), min_size=2, max_size=4))
def test_sums_of_parts_add_up_to_those_of_all_frames(seed: int, sizes: list[int]) -> None:
    rng = np.random.default_rng(seed)
    frames = [_random_frame(rng, size) for size in sizes]
    total = voxels.make_sums(1, 2)
    for frame in frames:
        part = _sum([frame], 0.5)
        n = int(part.used[0])
        total = voxels.add_rows(
            total, part.keys[:n], part.sums[:n], part.information[:n], part.frames[:n]
        )
    _check(total, frames, 0.5)


def test_a_row_is_found_where_it_was_entered_and_nowhere_else() -> None:
    table = voxels.make_table(10)
    keys = voxels.pack_keys(np.array([[1, 2, 3], [-4, 0, 9]]))
    voxels.enter_keys(table, keys)
    assert [voxels.find(table, key) for key in keys.tolist()] == [0, 1]
    assert voxels.find(table, voxels.pack_key(1, 2, 4)) == voxels.EMPTY


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
