"""The compiled search equals its reference, for any image, window and range."""

from __future__ import annotations

import itertools

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from hypothesis.extra import numpy as hnp

from recon.core.values.arrays import UInt8
from recon.stereo.kernels.half_windows import (
    Search,
    empty_scratch,
    empty_views,
    lay_out,
    widest_block,
)
from recon.stereo.kernels.minima import NO_COST, Minima, empty_minima
from recon.stereo.kernels.sad import sad_minima
from recon.stereo.kernels.simd.vectors import LANES
from recon.stereo.kernels.tiles import Tiles, make_tiles
from tests.stereo.kernels.references import assert_equal, pairs, sad_minima_reference

Pair = tuple[UInt8, UInt8]


def everything(shape: tuple[int, int], search: Search) -> Tiles:
    return make_tiles(shape, (shape[0], widest_block(search, shape[1])), search.ndisp)


def search_all(pair: Pair, search: Search, tiles: Tiles, strips: int = 1) -> Minima:
    minima, (left, right) = empty_minima(*pair[0].shape), pair
    views = empty_views(search, tiles.width, *left.shape)
    lay_out(left, right, search, 0, views)
    scratch = empty_scratch(search, tiles.width)
    edges = np.linspace(0, len(left), strips + 1).astype(int)
    for first, end in itertools.pairwise(edges):
        sad_minima(views, search, tiles, int(first), int(end), scratch, minima)
    return minima


searches = st.builds(
    Search,
    ndisp=st.integers(1, 28),
    minimum=st.integers(-16, 16),
    radius=st.integers(0, 4),
    rows_radius=st.integers(0, 4),
    cost_cap=st.sampled_from([1, 20, 255]),
    slant=st.integers(-2, 2),
)


@given(pairs((1, 9), (1, 13)), searches)
def test_search_equals_the_reference(pair: Pair, search: Search) -> None:
    tiles = everything(pair[0].shape, search)
    assert_equal(search_all(pair, search, tiles), sad_minima_reference(*pair, search, tiles))


@st.composite
def tilings(draw: st.DrawFn, shape: tuple[int, int], search: Search) -> Tiles:
    height = draw(st.integers(max(search.rows_radius, 1), 9))
    tiles = make_tiles(shape, (height, draw(st.integers(1, 40))), search.ndisp)
    return tiles._replace(offered=draw(hnp.arrays(np.bool_, tiles.offered.shape)))


@given(st.data(), pairs((1, 14), (1, 40)), searches, st.integers(1, 4))
def test_what_is_not_offered_is_as_if_it_did_not_exist(
    data: st.DataObject, pair: Pair, search: Search, strips: int
) -> None:
    tiles = data.draw(tilings(pair[0].shape, search))
    found = search_all(pair, search, tiles, min(strips, len(pair[0])))
    assert_equal(found, sad_minima_reference(*pair, search, tiles))


@pytest.mark.parametrize("slant", [0, 1, -2])
@pytest.mark.parametrize(("ndisp", "minimum"), [(64, 0), (65, -40), (33, 20), (100, 60)])
def test_wide_images_are_searched_in_vectors(ndisp: int, minimum: int, slant: int) -> None:
    rng = np.random.default_rng(ndisp + slant)
    # Few grey levels, so that vectors and runs have equal costs to decide between.
    left, right = rng.integers(0, 4, (2, 5, 3 * LANES + 35), dtype=np.uint8)
    search = Search(ndisp, minimum, 2, 1, cost_cap=2, slant=slant)
    assert ndisp + 2 * abs(slant) > LANES
    tiles = everything(left.shape, search)
    expected = sad_minima_reference(left, right, search, tiles)
    assert_equal(search_all((left, right), search, tiles), expected)


# One row: the sums over a column fit into bytes, those over two do not.
@pytest.mark.parametrize(("radius", "rows_radius"), [(7, 7), (1, 0), (4, 0)])
def test_largest_costs_do_not_overflow(radius: int, rows_radius: int) -> None:
    pair = np.full((40, 40), 255, np.uint8), np.zeros((40, 40), np.uint8)
    search = Search(3, 0, radius, rows_radius, cost_cap=255, slant=0)
    costs = search_all(pair, search, everything((40, 40), search)).costs[0]
    assert (costs == (2 * radius + 1) * 2 * (rows_radius + 1) * 255).all()
    assert costs.max() < NO_COST
