"""The compiled semi-global search equals its reference, for any image, window and range."""

from __future__ import annotations

import itertools

import numba
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from recon.core.values.arrays import UInt8
from recon.stereo.kernels.minima import Minima, empty_minima
from recon.stereo.kernels.path_costs import Views, Window, empty_planes, scaled_window, write_views
from recon.stereo.kernels.paths import Paths
from recon.stereo.kernels.semi_global import (
    ROWS,
    Scratch,
    bands_of,
    empty_scratch,
    scratch_bytes,
    semi_global_minima,
)
from tests.stereo.kernels.references import assert_equal, pairs, semi_global_minima_reference

Pair = tuple[UInt8, UInt8]


def make_views(pair: Pair, window: Window, paths: Paths) -> Views:
    for image in pair:
        image.flags.writeable = False  # as those of a pair: kernels are compiled for them
    left, right = pair
    views = Views(left, *empty_planes(*left.shape, window.radius, paths.ndisp))
    write_views(right, window.radius, paths.minimum, range(len(left)), views)
    return views


def search(
    views: Views, window: Window, paths: Paths, strips: int = 1, columns: int | None = None
) -> Minima:
    minima = empty_minima(*views.grey.shape)
    edges = np.linspace(0, len(views.grey), strips + 1).astype(int).tolist()
    for first, end in itertools.pairwise(edges):
        scratch = empty_scratch(views.grey.shape[1], paths)
        if columns:
            scratch = Scratch(np.zeros(scratch_bytes(columns, paths), np.uint8), columns)
        semi_global_minima(views, window, paths, range(first, end), scratch, minima)
    return minima


@st.composite
def windows(draw: st.DrawFn) -> tuple[Window, Paths]:
    radius, rows_radius = draw(st.tuples(st.integers(0, 3), st.integers(0, 3)))
    cap = draw(st.sampled_from([0, 16, 120]))
    p1, more = draw(st.tuples(st.integers(1, 40), st.integers(0, 80)))
    # The largest that a path cost leaves: cost + P1 + P2 <= 254.
    top = 254 - 2 * p1 - more
    window = scaled_window(radius, rows_radius, cap, cap + 24, top / (cap + 24))
    ndisp = draw(st.sampled_from([1, 2, 3, 4, 5, 17, 70, 260]))
    minimum, edge = draw(st.integers(-6, 6)), draw(st.sampled_from([0, 12, 255]))
    return window, Paths(ndisp, minimum, p1, p1 + more, p1, edge, overlap=100, side_overlap=100)


@settings(max_examples=70)
@given(pairs((1, 7), (1, 9)), windows(), st.integers(1, 4))
def test_search_equals_the_reference(pair: Pair, rules: tuple[Window, Paths], strips: int) -> None:
    """In strips that overlap wholly."""
    views = make_views(pair, *rules)
    assert_equal(search(views, *rules, strips), semi_global_minima_reference(views, *rules))


def test_few_rows_of_overlap_change_little() -> None:
    left = np.random.default_rng(0).integers(0, 256, (80, 60), dtype=np.uint8)
    paths = Paths(16, 0, 10, 50, 20, 12, overlap=8, side_overlap=8)
    window = scaled_window(1, 1, 16, 40, 3.0)
    views = make_views((left, np.roll(left, -5, axis=1)), window, paths)
    whole, strips = search(views, window, paths), search(views, window, paths, strips=4)
    assert (whole.winner == strips.winner).mean() > 0.99


@pytest.mark.parametrize("shape", [(3 * ROWS + 5, 70), (2 * ROWS, 64)])
@pytest.mark.parametrize("overlap", [4 * ROWS, 2 * ROWS + 1])
def test_an_image_of_several_blocks_equals_the_reference(
    shape: tuple[int, int], overlap: int
) -> None:
    """Paths from above go on from block to block; those from below reach through all below."""
    pair = tuple(np.random.default_rng(1).integers(0, 256, (2, *shape), dtype=np.uint8))
    paths = Paths(9, -2, 10, 50, 20, 12, overlap=max(overlap, shape[0]), side_overlap=70)
    window = scaled_window(1, 2, 16, 40, 3.0)
    views = make_views(pair, window, paths)
    expected = semi_global_minima_reference(views, window, paths)
    assert_equal(search(views, window, paths, strips=2), expected)


@pytest.mark.parametrize("minimum", [-70, 0, 3])
@pytest.mark.parametrize("side_overlap", [0, 9])
def test_bands_equal_the_reference_that_begins_paths_at_their_sides(
    minimum: int, side_overlap: int
) -> None:
    """The right view is put together from all bands."""
    rows = 2 if numba.config.DISABLE_JIT else 9
    left, right = np.random.default_rng(2).integers(0, 256, (2, rows, 300), dtype=np.uint8)
    right[:, :200] = left[:, 20:220]
    paths = Paths(70, minimum, 10, 50, 20, 12, overlap=rows, side_overlap=side_overlap)
    window = scaled_window(2, 2, 16, 40, 3.0)
    views = make_views((left, right), window, paths)
    for strips, columns in ((1, 64), (2, 128)):
        bands = bands_of(300, columns, window, paths)
        expected = semi_global_minima_reference(views, window, paths, bands)
        assert len(bands) > 1
        assert_equal(search(views, window, paths, strips, columns), expected)


@given(st.integers(0, 15), st.integers(0, 15), st.integers(1, 207), st.floats(0.05, 6.0))
def test_a_scaled_window_stays_within_its_widths(
    radius: int, rows_radius: int, largest: int, levels: float
) -> None:
    window = scaled_window(radius, rows_radius, 14, largest, min(levels, 250 / largest))
    across = ((2 * radius + 1) * largest) >> window.row_shift
    most = across * (2 * rows_radius + 1)
    assert across <= 255
    assert most * window.factor <= 65535
    assert most * window.factor >> window.shift == window.top <= 250
    # What is said of the scale is what the largest cost becomes, but for bits that were cut.
    assert window.levels * largest == pytest.approx(window.top, rel=0.1, abs=1.5)
