"""Parts of a drive that are chained give what one drive would have given, clamps included."""

from __future__ import annotations

import numba
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from recon.core.geometry.se3 import exp_so3, make_transform
from recon.core.kernels import voxels
from recon.map.kernels import clamped, raycast
from tests.map.kernels.reference import (
    Cell,
    apply_evidence_reference,
    cells_of,
    log_odds_of,
    move_reference,
)

LOWEST, HIGHEST = -2.0, 3.5
Frame = dict[Cell, float]

# float32 against float64: the sum of 20 changes of 1.9 at most, each partial sum rounded, which is
# 2^-24 · 1.9 · (1 + … + 20) = 2.4e-5, and a sum of parts with one of its own.
ROUNDING = 3e-5


def _evidence(frame: Frame) -> raycast.Blocks:
    evidence = raycast.make_blocks(64)
    for cell, change in frame.items():
        key = voxels.pack_key(*(index >> 3 for index in cell))
        row = voxels.find_or_add(evidence.table, key, int(evidence.used[0]))
        if row == evidence.used[0]:
            evidence.keys[row] = key
            evidence.used[0] += 1
        i, j, k = (index & 7 for index in cell)
        evidence.values[row, (i * 8 + j) * 8 + k] = change
    return evidence


def _drive(frames: list[Frame]) -> clamped.ClampedBlocks:
    """Starts with the smallest store, so that every test also tests growth."""
    blocks = clamped.make_clamped(1)
    for frame in frames:
        blocks = clamped.add_evidence(blocks, _evidence(frame), LOWEST, HIGHEST)
    return blocks


def _random_frames(seed: int, number: int) -> list[Frame]:
    rng = np.random.default_rng(seed)
    # Few cells, so that most are seen often and reach their clamps; some in other blocks.
    places = rng.integers(-12, 12, (6, 3))
    return [
        {
            tuple(place): float(np.float32(rng.choice([-1.5, -0.5, 0.8, 1.9])))
            for place in places[rng.random(6) < 0.7].tolist()
        }
        for _ in range(number)
    ]


@settings(max_examples=60)
@given(seed=st.integers(0, 2**32 - 1), cut=st.integers(0, 20), again=st.integers(0, 20))
def test_parts_in_a_row_equal_one_drive(seed: int, cut: int, again: int) -> None:
    frames = _random_frames(seed, 20)
    first, last = sorted((cut, again))
    total = clamped.make_clamped(1)
    for part in (frames[:first], frames[first:last], frames[last:]):
        total = clamped.chain_rows(total, clamped.observed_rows(_drive(part)))
    expected: Frame = {}
    for frame in frames:
        apply_evidence_reference(expected, frame, LOWEST, HIGHEST)
    found = log_odds_of(total)
    assert found.keys() == expected.keys()
    for cell, value in found.items():
        assert value == pytest.approx(expected[cell], abs=ROUNDING)


def test_what_a_later_part_looks_through_is_free_however_often_it_was_hit() -> None:
    cell = (1, 2, 3)
    parked, gone = [{cell: 1.0}] * 20, [{cell: -0.5}] * 12
    total = _drive(parked)
    total = clamped.chain_rows(total, clamped.observed_rows(_drive(gone)))
    # 3.5 after the hits, 12 misses of 0.5 later below 0; a sum of the clamped parts stays above.
    assert log_odds_of(total)[cell] == pytest.approx(-2.0)
    assert 3.5 + log_odds_of(_drive(gone))[cell] > 0


@settings(max_examples=5 if numba.config.DISABLE_JIT else 30)
@given(seed=st.integers(0, 2**32 - 1))
def test_moved_cells_equal_those_of_the_reference(seed: int) -> None:
    rng = np.random.default_rng(seed)
    blocks = _drive(_random_frames(seed, 5))
    T = make_transform(exp_so3(rng.normal(0, 0.5, 3)), rng.normal(0, 20, 3))
    assert cells_of(clamped.move_blocks(blocks, T)) == move_reference(cells_of(blocks), T)


def test_a_turned_wall_has_no_holes() -> None:
    wall = {(i, 0, k): 1.0 for i in range(-20, 20) for k in range(-20, 20)}
    blocks = clamped.make_clamped(1)
    blocks = clamped.add_evidence(blocks, _evidence(wall), LOWEST, HIGHEST)
    T = make_transform(exp_so3(np.array([0.0, 0.0, 0.1])), np.zeros(3))
    moved = cells_of(clamped.move_blocks(blocks, T))
    # Every column across the wall has it, at all heights.
    assert {(i, k) for i, _, k in moved} >= {(i, k) for i in range(-18, 18) for k in range(-20, 20)}
