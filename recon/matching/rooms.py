"""Memory that a matcher works in, kept from one pair to the next.

A system hands out memory page by page, and clears each: for pictures that takes longer than some
searches.
"""

from __future__ import annotations

from collections import deque
from collections.abc import Callable, Hashable, Iterator
from contextlib import contextmanager
from typing import Generic, TypeVar

import numpy as np

from recon.structures.arrays import UInt8

T = TypeVar("T")


class Rooms(Generic[T]):
    """Lends rooms of one kind; threads may borrow at the same time.

    Args:
        make: Makes a room of a size, when there is none to lend.
        most: So many are kept.
    """

    def __init__(self, make: Callable[..., T], most: int) -> None:
        self._make = make
        self._free: deque[tuple[tuple[Hashable, ...], T]] = deque(maxlen=most)

    @contextmanager
    def borrow(self, *size: Hashable) -> Iterator[T]:
        """Lend a room for a while; what it holds at first does not matter.

        Args:
            size: What ``make`` takes. A room of another size is given up.
        """
        try:
            kept, room = self._free.pop()
        except IndexError:
            kept = None
        if kept != size:
            room = self._make(*size)
        yield room
        # Not after an error: somebody may still work in it.
        self._free.append((size, room))


class Loans:
    """Lends memory for results, which comes back by itself when nobody holds the result any more.

    Args:
        most: So many blocks that came back are kept.
    """

    def __init__(self, most: int) -> None:
        self._free: deque[UInt8] = deque(maxlen=most)

    def lend(self, size_bytes: int) -> UInt8:
        """uint8 (size_bytes,), lent for as long as it or a view of it is held."""
        try:
            block = self._free.pop()
        except IndexError:
            block = np.empty(0, np.uint8)
        if block.size != size_bytes:
            block = np.empty(size_bytes, np.uint8)
        return np.asarray(_Loan(block, self._free))


class _Loan:
    """What an array on loan, and so each view of it, keeps alive."""

    def __init__(self, block: UInt8, free: deque[UInt8]) -> None:
        self.__array_interface__ = block.__array_interface__
        self._block, self._free = block, free

    def __del__(self) -> None:
        self._free.append(self._block)
