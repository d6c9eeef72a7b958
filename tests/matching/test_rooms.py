"""Memory on loan is nobody else's while it is held, and used again when it is not."""

from __future__ import annotations

import numpy as np

from recon.matching.rooms import Loans


def test_memory_that_nobody_holds_is_lent_again() -> None:
    loans = Loans(2)
    block = loans.lend(4096)
    address = block.ctypes.data
    del block
    assert loans.lend(4096).ctypes.data == address


def test_memory_stays_lent_while_a_view_of_it_is_held() -> None:
    loans = Loans(2)
    view = loans.lend(4096)[:4000].view(np.float32).reshape(10, 100)[2:]
    view[:] = 7
    loans.lend(4096)[:] = 0
    loans.lend(4096)[:] = 0
    assert (view == 7).all()


def test_memory_of_another_size_is_given_up() -> None:
    loans = Loans(2)
    loans.lend(4096)
    assert loans.lend(100).shape == (100,)
