"""The compiled average of opposite neighbours equals its reference, and leaves surfaces alone."""

from __future__ import annotations

import math

import numpy as np
from hypothesis import given
from hypothesis import strategies as st
from hypothesis.extra import numpy as hnp
from numpy.typing import NDArray

from recon.stereo.kernels.finish import average_opposite, find_speckles

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


def average_opposite_reference(
    values: NDArray[np.float32], radius: int, largest_step: float
) -> NDArray[np.float64]:
    """As `opposite.average_opposite` of all rows, one pixel after the other."""
    averages = np.full(values.shape, np.nan)
    rows, columns = np.indices((2 * radius + 1, 2 * radius + 1))
    chessboard = (rows + columns) % 2 == 0
    for y, x in zip(*np.nonzero(np.isfinite(values)), strict=True):
        near = _square(values, int(y), int(x), radius)
        near[~(np.abs(near - values[y, x]) <= largest_step)] = np.nan
        near[~chessboard] = np.nan
        # Turned by half a turn, each neighbour lies on its opposite; the pixel on itself.
        near[np.isnan(near[::-1, ::-1])] = np.nan
        averages[y, x] = np.nanmean(near)
    return averages


def _square(values: NDArray[np.float32], y: int, x: int, radius: int) -> NDArray[np.float64]:
    """Return the square around a pixel; NaN beyond the image."""
    padded = np.pad(values.astype(float), radius, constant_values=np.nan)
    width = 2 * radius + 1
    return np.array(padded[y : y + width, x : x + width])


steps = hnp.arrays(
    np.float32,
    st.tuples(st.integers(1, 8), st.integers(1, 8)),
    elements=st.one_of(st.sampled_from([0.0, 0.5, 1.0, 2.5, 4.0]), st.just(math.nan)),
)


@given(steps, st.sampled_from([0.5, 1.0, 2.0]), st.integers(0, 20))
def test_speckles_equal_those_of_the_reference(values: np.ndarray, step: float, size: int) -> None:
    found = find_speckles(values, step, size)
    np.testing.assert_array_equal(found, find_speckles_reference(values, step, size))


def test_region_of_the_smallest_size_stays() -> None:
    values = np.full((4, 6), np.nan, np.float32)
    values[1, 1:4] = 5.0
    assert not find_speckles(values, 1.0, 3).any()
    np.testing.assert_array_equal(find_speckles(values, 1.0, 4), np.isfinite(values))


def test_corners_do_not_connect() -> None:
    values = np.array([[1, np.nan], [np.nan, 1]], np.float32)
    np.testing.assert_array_equal(find_speckles(values, 1.0, 2), np.isfinite(values))


def find_speckles_reference(
    values: NDArray[np.float32], largest_step: float, smallest_size: int
) -> NDArray[np.bool_]:
    """As `recon.stereo.kernels.finish.find_speckles`, by flooding one region after the other."""
    small = np.zeros(values.shape, np.bool_)
    todo = np.isfinite(values)
    while todo.any():
        seed = np.unravel_index(int(np.argmax(todo)), values.shape)
        region = _flood(values, (int(seed[0]), int(seed[1])), largest_step)
        todo &= ~region
        if region.sum() < smallest_size:
            small |= region
    return small


def _flood(
    values: NDArray[np.float32], seed: tuple[int, int], largest_step: float
) -> NDArray[np.bool_]:
    region = np.zeros(values.shape, np.bool_)
    region[seed] = True
    waiting = [seed]
    while waiting:
        y, x = waiting.pop()
        for v, u in ((y - 1, x), (y + 1, x), (y, x - 1), (y, x + 1)):
            inside = 0 <= v < values.shape[0] and 0 <= u < values.shape[1]
            if inside and not region[v, u] and abs(values[v, u] - values[y, x]) <= largest_step:
                region[v, u] = True
                waiting.append((v, u))
    return region
