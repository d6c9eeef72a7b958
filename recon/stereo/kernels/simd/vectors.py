"""What vectors do, in plain numpy: the definition of each function, and the fallback without numba.

Arithmetic (``+ - * >>``) wraps around, as numpy's does. Bounds are never checked.
"""

from __future__ import annotations

from typing import Any, Final, TypeAlias

import numpy as np
from numpy.typing import NDArray

# Values of a vector. In 16 bits they fill 512 bits; of smaller registers the compiler uses several.
LANES: Final = 32
WIDE: Final = 16  # values of a vector of 32 bits each
SUMS: Final = 8  # vectors that are added to at a time, so that all stay in registers

Vector: TypeAlias = NDArray[Any]  # uint8 or uint16 (LANES,), int32 or float32 (WIDE,)
Sums: TypeAlias = tuple[Vector, ...]  # `SUMS` vectors of int32


def _lanes(values: NDArray[Any] | np.generic) -> int:
    return WIDE if values.dtype.itemsize == np.dtype(np.int32).itemsize else LANES


def load(array: NDArray[Any], at: int) -> Vector:
    """Return as many values of an array (n,) as a vector has, from ``at`` on."""
    vector: Vector = array[at : at + _lanes(array)].copy()
    return vector


def store(array: NDArray[Any], at: int, vector: Vector) -> None:
    """Write a vector from ``at`` on."""
    array[at : at + vector.size] = vector


def load_row(rows: NDArray[Any], n: int, at: int) -> Vector:
    """Return `load` from row ``n`` of a C-ordered array of rows."""
    return load(rows[n], at)


def store_row(rows: NDArray[Any], n: int, at: int, vector: Vector) -> None:
    """`store` to row ``n`` of a C-ordered array of rows."""
    store(rows[n], at, vector)


def splat(value: np.uint8 | np.uint16 | np.float32) -> Vector:
    """Return the same value in each lane."""
    return np.full(_lanes(value), value)


def splat_at(rows: NDArray[Any], n: int, at: int) -> Vector:
    """Return value ``at`` of row ``n`` in each lane."""
    return splat(rows[n, at])


def ramp(first: np.uint16) -> Vector:
    """Return ``first``, ``first + 1`` and so on."""
    return np.arange(LANES, dtype=np.uint16) + first


def smaller(a: Vector, b: Vector) -> Vector:
    """Return the smaller value of each lane."""
    return np.minimum(a, b)


def larger(a: Vector, b: Vector) -> Vector:
    """Return the larger value of each lane."""
    return np.maximum(a, b)


def absolute_difference(a: Vector, b: Vector) -> Vector:
    """``|a - b|`` of each lane."""
    return np.maximum(a, b) - np.minimum(a, b)


def mean(a: Vector, b: Vector) -> Vector:
    """Return the mean of two bytes, rounded up."""
    return ((a.astype(np.uint16) + b + 1) >> 1).astype(np.uint8)


def differing_bits(a: Vector, b: Vector) -> Vector:
    """Return how many bits of two bytes differ."""
    bits = np.unpackbits(np.bitwise_xor(a, b)).reshape(-1, 8)
    return np.asarray(bits.sum(axis=1, dtype=np.uint8))


def where_equal(a: Vector, b: Vector, then: Vector, otherwise: Vector) -> Vector:
    """Return ``then`` in the lanes where ``a == b``."""
    return np.where(a == b, then, otherwise)


def where_less(a: Vector, b: Vector, then: Vector, otherwise: Vector) -> Vector:
    """Return ``then`` in the lanes where ``a < b``."""
    return np.where(a < b, then, otherwise)


def widen(vector: Vector, array: NDArray[Any]) -> Vector:
    """Convert bytes to the dtype of an array."""
    return vector.astype(array.dtype)


def narrow(vector: Vector) -> Vector:
    """Return the lower bytes of uint16."""
    return vector.astype(np.uint8)


def put_before(vector: Vector, before: Vector) -> Vector:
    """Return each lane's neighbour below; that of the first lane is the last of ``before``."""
    return np.concatenate((before[-1:], vector[:-1]))


def put_after(vector: Vector, after: Vector) -> Vector:
    """Return each lane's neighbour above; that of the last lane is the first of ``after``."""
    return np.concatenate((vector[1:], after[:1]))


def broadcast_smallest(vector: Vector) -> Vector:
    """Return the smallest value, in each lane."""
    return np.full_like(vector, vector.min())


def transpose(rows: NDArray[Any], n: int, at: int, out: NDArray[Any], m: int, to: int) -> None:
    """Write a block of `LANES` by `LANES` bytes at (n, at), transposed, to ``out`` at (m, to)."""
    out[m : m + LANES, to : to + LANES] = rows[n : n + LANES, at : at + LANES].T


def no_sums() -> Sums:
    """Return sums of nothing."""
    return tuple(np.zeros((SUMS, WIDE), np.int32))


def _products(a: Vector, b: Vector) -> Vector:
    """Return what pairs of int16, each pair an int32, add up to when multiplied."""
    products = a.view(np.int16).astype(np.int32) * b.view(np.int16)
    return np.asarray(products.reshape(-1, 2).sum(axis=1, dtype=np.int32))


def add_products(sums: Sums, pairs: Vector, rows: NDArray[np.int32], n: int, at: int) -> Sums:
    """Add to sum ``i`` the products of pairs of int16 with the pair ``at + i`` of row ``n``."""
    return tuple(one + _products(pairs, splat_at(rows, n, at + i)) for i, one in enumerate(sums))


def add_shifted(sums: Sums, pairs: Vector, rows: NDArray[np.int32], n: int, at: int) -> Sums:
    """Add to sum ``i`` the products of pairs with those of row ``n`` from ``at - i`` on."""
    return tuple(one + _products(pairs, load_row(rows, n, at - i)) for i, one in enumerate(sums))


def store_sums(rows: NDArray[np.int32], n: int, at: int, sums: Sums) -> None:
    """Write each sum from ``at`` on, one to a row, from row ``n`` on."""
    for i, one in enumerate(sums):
        store_row(rows, n + i, at, one)
