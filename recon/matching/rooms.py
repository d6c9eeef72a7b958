"""Memory that a matcher works in, kept from one pair to the next.

A system hands out memory page by page, and clears each: for pictures that takes longer than some
searches.
"""

from __future__ import annotations

from collections import deque
from collections.abc import Callable, Hashable, Iterator
from contextlib import contextmanager
from typing import Generic, TypeVar

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
