"""The cache of what was read from a map, bounded in bytes."""

from __future__ import annotations

from collections import OrderedDict
from collections.abc import Callable, Hashable, Mapping
from dataclasses import fields, is_dataclass
from threading import Lock
from typing import Any, Final, TypeVar

import numpy as np

Value = TypeVar("Value")
_PLAIN_BYTES: Final = 64
"""About what a number or a short text takes."""


class Cache:
    """Keeps the values used last, up to a number of bytes. Threads may share it.

    Args:
        limit_bytes: Most that the kept values take together; 0 = nothing is kept.
    """

    def __init__(self, limit_bytes: int) -> None:
        self._limit = limit_bytes
        self._held: OrderedDict[Hashable, tuple[Any, int]] = OrderedDict()
        self._size = 0
        self._lock = Lock()

    @property
    def nbytes(self) -> int:
        """Bytes that the kept values take."""
        return self._size

    def get(self, key: Hashable, make: Callable[[], Value]) -> Value:
        """Return the value of a key, made now unless it is kept; two threads may both make it."""
        with self._lock:
            if key in self._held:
                self._held.move_to_end(key)
                found: Value = self._held[key][0]
                return found
        value = make()
        self._keep(key, value)
        return value

    def drop(self, key: Hashable) -> None:
        """Forget a value."""
        with self._lock:
            self._size -= self._held.pop(key, (None, 0))[1]

    def clear(self) -> None:
        """Forget all values."""
        with self._lock:
            self._held.clear()
            self._size = 0

    def _keep(self, key: Hashable, value: object) -> None:
        size = size_of(value)
        if size > self._limit:  # would drive out everything else, and then itself
            return
        with self._lock:
            self._size += size - self._held.pop(key, (None, 0))[1]
            self._held[key] = value, size
            while self._size > self._limit:
                self._size -= self._held.popitem(last=False)[1][1]


def size_of(value: object) -> int:
    """Return bytes of the arrays in a value: in mappings, sequences and dataclasses."""
    if isinstance(value, np.ndarray):
        return value.nbytes
    if isinstance(value, Mapping):
        return _PLAIN_BYTES + sum(map(size_of, value.values()))
    if isinstance(value, list | tuple):
        return _PLAIN_BYTES + sum(map(size_of, value))
    if is_dataclass(value):
        return _PLAIN_BYTES + sum(size_of(getattr(value, f.name)) for f in fields(value))
    return _PLAIN_BYTES
