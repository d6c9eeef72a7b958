"""What matches at half size support is offered, by the compiled kernel and by its reference."""

from __future__ import annotations

import numpy as np
from hypothesis import given
from hypothesis import strategies as st
from hypothesis.extra import numpy as hnp

from recon.core.values.arrays import Float32
from recon.stereo.kernels.tiles import GROUP, Support, Tiles, make_tiles, offer_supported
from tests.stereo.kernels.references import offer_supported_reference, offered_reference

NDISP = 40
LENIENT = Support(margin_x=0, margin_y=0, margin=0, matched=0.0, share=0.0, least=1)


def offered(halved: Float32, support: Support, minimum: int = 0) -> Tiles:
    tiles = make_tiles((2 * halved.shape[0], 2 * halved.shape[1]), (8, 16), NDISP)
    rows = len(tiles.offered)
    for first, end in ((0, rows // 2), (rows // 2, rows)):
        offer_supported(halved, minimum, NDISP, support, first, end, tiles)
    return tiles


supports = st.builds(
    Support,
    margin_x=st.integers(0, 9),
    margin_y=st.integers(0, 9),
    margin=st.integers(0, 9),
    matched=st.sampled_from([0.0, 0.3, 1.0]),
    share=st.sampled_from([0.0, 0.1, 0.6]),
    least=st.integers(0, 5),
)
disparities = st.one_of(st.just(np.nan), st.integers(-4, 30))


@given(
    hnp.arrays(np.float32, st.tuples(st.integers(1, 20), st.integers(1, 30)), elements=disparities),
    st.integers(-9, 9),
    supports,
)
def test_support_equals_the_reference(halved: Float32, minimum: int, support: Support) -> None:
    tiles = offered(halved, support, minimum)
    expected = offer_supported_reference(halved, minimum, NDISP, support, tiles)
    np.testing.assert_array_equal(tiles.offered, expected)


def test_only_the_group_of_a_match_is_offered_and_only_to_its_tile() -> None:
    halved = np.full((8, 16), np.nan, np.float32)
    halved[5, 9] = 10
    tiles = offered(halved, LENIENT)
    assert np.argwhere(tiles.offered).tolist() == [[1, 1, 20 // GROUP]]
    candidates = offered_reference(tiles, (16, 32), NDISP)
    assert candidates.any(axis=(0, 1)).nonzero()[0].tolist() == list(range(16, 24))
    assert candidates.any(axis=2).nonzero()[0].min() == 8


def test_a_tile_with_too_few_matches_is_offered_everything() -> None:
    halved = np.full((8, 8), np.nan, np.float32)
    halved[:4, :7], halved[4:, :3] = 3, 3
    tiles = offered(halved, LENIENT._replace(matched=0.5))
    assert tiles.offered[0, 0].tolist() == [True, False, False, False, False]
    assert tiles.offered[1, 0].all()
