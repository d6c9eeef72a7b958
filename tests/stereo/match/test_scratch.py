"""Scratch memory is never shared while it is referenced, and is reused afterwards."""

from __future__ import annotations

import numpy as np

from recon.stereo.match.search import ResultPool


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
