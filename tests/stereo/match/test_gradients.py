"""What is computed of some rows is what all rows have there."""

from __future__ import annotations

import itertools

import numpy as np
import pytest

from recon.core.values import RectifiedPair
from recon.io.middlebury import stand_in_camera
from recon.stereo.match.search import ResultPool, clipped_gradients, texture

HEIGHT, WIDTH = 23, 17
ALL = range(HEIGHT)
RNG = np.random.default_rng(5)
IMAGE = RNG.integers(0, 256, (HEIGHT, WIDTH), dtype=np.uint8)

strips = pytest.mark.parametrize("edges", [(0, 11, 23), (0, 1, 2, 22, 23), range(24)])


@strips
def test_gradients_do_not_depend_on_the_strips(edges: tuple[int, ...]) -> None:
    parts = [clipped_gradients(IMAGE, range(*rows)) for rows in itertools.pairwise(edges)]
    np.testing.assert_array_equal(np.vstack(parts), clipped_gradients(IMAGE, ALL))


@strips
@pytest.mark.parametrize("window_px", [1, 11, 61])
def test_texture_does_not_depend_on_the_strips(edges: tuple[int, ...], window_px: int) -> None:
    pair = RectifiedPair(
        IMAGE, IMAGE, stand_in_camera(WIDTH, HEIGHT, 8), valid=RNG.random(IMAGE.shape) < 0.9
    )
    parts = [texture(pair, window_px, range(*rows)) for rows in itertools.pairwise(edges)]
    np.testing.assert_array_equal(np.vstack(parts), texture(pair, window_px, ALL))


def test_texture_of_a_ramp_is_its_slope() -> None:
    ramp = np.tile(np.arange(0, 3 * WIDTH, 3, dtype=np.uint8), (HEIGHT, 1))
    pair = RectifiedPair(ramp, ramp, stand_in_camera(WIDTH, HEIGHT, 8))
    found = texture(pair, 5, range(4, 9))
    # Away from the border, where the gradient of a continued image is half as large.
    np.testing.assert_allclose(found[:, 3:-3], 3.0, rtol=1e-6)


def test_unreferenced_memory_is_lent_again() -> None:
    pool = ResultPool(2)
    block = pool.lend(4096)
    address = block.ctypes.data
    del block
    assert pool.lend(4096).ctypes.data == address


def test_memory_stays_lent_while_a_view_of_it_is_referenced() -> None:
    pool = ResultPool(2)
    view = pool.lend(4096)[:4000].view(np.float32).reshape(10, 100)[2:]
    view[:] = 7
    pool.lend(4096)[:] = 0
    pool.lend(4096)[:] = 0
    assert (view == 7).all()


def test_memory_of_another_size_is_given_up() -> None:
    pool = ResultPool(2)
    pool.lend(4096)
    assert pool.lend(100).shape == (100,)
