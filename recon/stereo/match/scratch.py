"""Memory that a matcher keeps from one pair to the next.

The system clears new memory page by page when it is first touched: for images that takes longer
than some searches.
"""

from __future__ import annotations

from collections import deque
from collections.abc import Callable, Hashable, Iterator
from contextlib import contextmanager
from typing import Generic, TypeVar

import numpy as np

from recon.core.values.arrays import UInt8

T = TypeVar("T")


class ScratchPool(Generic[T]):
    """Lends scratch memory of one kind, also to several threads at once.

    Args:
        make: Makes scratch memory of a size, when there is none to lend.
        most: How many pieces are kept.
    """

    def __init__(self, make: Callable[..., T], most: int) -> None:
        self._make = make
        self._free: deque[tuple[tuple[Hashable, ...], T]] = deque(maxlen=most)

    @contextmanager
    def borrow(self, *size: Hashable) -> Iterator[T]:
        """Lend scratch memory for a ``with`` block; its content is undefined.

        Args:
            size: Arguments of ``make``. A kept piece of another size is given up.
        """
        try:
            kept, scratch = self._free.pop()
        except IndexError:
            kept = None
        if kept != size:
            scratch = self._make(*size)
        yield scratch
        # Not after an error: another thread may still work in it.
        self._free.append((size, scratch))


class ResultPool:
    """Lends memory for results, which returns when the last reference to it is gone.

    Args:
        most: How many returned blocks are kept.
    """

    def __init__(self, most: int) -> None:
        self._free: deque[UInt8] = deque(maxlen=most)

    def lend(self, size_bytes: int) -> UInt8:
        """Return uint8 (size_bytes,), lent as long as it or a view of it is referenced."""
        try:
            block = self._free.pop()
        except IndexError:
            block = np.empty(0, np.uint8)
        if block.size != size_bytes:
            block = np.empty(size_bytes, np.uint8)
        return np.asarray(_Lent(block, self._free))


class _Lent:
    """The base of a lent array and of its views: its deletion returns the memory."""

    def __init__(self, block: UInt8, free: deque[UInt8]) -> None:
        self.__array_interface__ = block.__array_interface__
        self._block, self._free = block, free

    def __del__(self) -> None:
        self._free.append(self._block)
