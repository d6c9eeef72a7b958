"""Averages of opposite neighbours and speckles equal their reference, which is plain and slow."""

from __future__ import annotations

import math

import numpy as np
from hypothesis import given
from hypothesis import strategies as st
from hypothesis.extra import numpy as hnp

from recon.core.values.arrays import Bool, Float32, Float64
from recon.stereo.kernels.finish import average_opposite, find_speckles

shapes = st.tuples(st.integers(1, 9), st.integers(1, 9))
nan = st.just(math.nan)
maps = hnp.arrays(np.float32, shapes, elements=st.floats(0, 3, width=16) | nan)
steps = hnp.arrays(np.float32, shapes, elements=st.sampled_from([0.0, 0.5, 1.0, 2.5, 4.0]) | nan)


def average_reference(values: Float32, radius: int, largest_step: float) -> Float64:
    """Return `average_opposite` of all rows, one pixel after the other."""
    averages, side = np.full(values.shape, np.nan), 2 * radius + 1
    chessboard = np.indices((side, side)).sum(axis=0) % 2 == 0
    padded = np.pad(values.astype(float), radius, constant_values=np.nan)
    for y, x in zip(*np.nonzero(np.isfinite(values)), strict=True):
        near = padded[y : y + side, x : x + side].copy()
        near[~(np.abs(near - values[y, x]) <= largest_step) | ~chessboard] = np.nan
        # Turned by half a turn, each neighbour lies on its opposite; the pixel on itself.
        near[np.isnan(near[::-1, ::-1])] = np.nan
        averages[y, x] = np.nanmean(near)
    return averages


def average(values: Float32, radius: int = 3, largest_step: float = 1.0) -> Float32:
    """All rows, in two strips."""
    averages, middle = np.full_like(values, -1.0), len(values) // 2
    for first, end in ((0, middle), (middle, len(values))):
        average_opposite(values, radius, largest_step, first, end, averages)
    return averages


@given(maps, st.integers(0, 4), st.sampled_from([0.25, 1.0, 5.0]))
def test_averages_equal_those_of_the_reference(values: Float32, radius: int, step: float) -> None:
    # float32: up to 40 pairs, each added up and added on, and a division, of values up to 3.
    rounding, expected = 42 * 2.0**-24 * 3, average_reference(values, radius, step)
    np.testing.assert_allclose(average(values, radius, step), expected, rtol=0, atol=rounding)


slopes = st.floats(-0.3, 0.3)


@given(slopes, slopes, hnp.arrays(np.bool_, (12, 14)))
def test_slope_with_holes_stays_as_it_is(across: float, down: float, holes: Bool) -> None:
    y, x = np.mgrid[:12, :14]
    slope = np.where(holes, np.nan, 20 + across * x + down * y).astype(np.float32)
    # float32 values below 28: the slope's own rounding, and 24 pairs added up.
    rounding = (2 + 26) * 2.0**-24 * 28
    np.testing.assert_allclose(average(slope, largest_step=5.0), slope, rtol=0, atol=rounding)


def test_noise_shrinks_by_the_root_of_the_number_of_pixels_and_steps_stay_sharp() -> None:
    noise = np.random.default_rng(1).normal(30, 0.1, (60, 80)).astype(np.float32)
    pixels = 25  # of a chessboard of 7 by 7
    assert average(noise)[3:-3, 3:-3].std() < 1.2 * 0.1 / math.sqrt(pixels)
    step = np.repeat(np.float32([10, 20]), 8)[None].repeat(9, axis=0)
    np.testing.assert_array_equal(average(step), step)


def speckles_reference(values: Float32, largest_step: float, smallest_size: int) -> Bool:
    """Return `find_speckles`, by flooding one region after the other."""
    small, todo = np.zeros(values.shape, np.bool_), np.isfinite(values)
    while todo.any():
        seed = np.unravel_index(int(np.argmax(todo)), values.shape)
        region, waiting = np.zeros(values.shape, np.bool_), [(int(seed[0]), int(seed[1]))]
        region[seed] = True
        while waiting:
            y, x = waiting.pop()
            for v, u in ((y - 1, x), (y + 1, x), (y, x - 1), (y, x + 1)):
                inside = 0 <= v < values.shape[0] and 0 <= u < values.shape[1]
                if inside and not region[v, u] and abs(values[v, u] - values[y, x]) <= largest_step:
                    region[v, u] = True
                    waiting.append((v, u))
        todo &= ~region
        small |= region & (region.sum() < smallest_size)
    return small


@given(steps, st.sampled_from([0.5, 1.0, 2.0]), st.integers(0, 20))
def test_speckles_equal_those_of_the_reference(values: Float32, step: float, size: int) -> None:
    found = find_speckles(values, step, size)
    np.testing.assert_array_equal(found, speckles_reference(values, step, size))


def test_region_of_the_smallest_size_stays_and_corners_do_not_connect() -> None:
    values = np.full((4, 6), np.nan, np.float32)
    values[1, 1:4] = 5.0
    assert not find_speckles(values, 1.0, 3).any()
    np.testing.assert_array_equal(find_speckles(values, 1.0, 4), np.isfinite(values))
    corners = np.array([[1, np.nan], [np.nan, 1]], np.float32)
    np.testing.assert_array_equal(find_speckles(corners, 1.0, 2), np.isfinite(corners))
