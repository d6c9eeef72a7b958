"""Small regions of a disparity map that hang together with nothing around them."""

from __future__ import annotations

import numpy as np
from numba import njit
from numpy.typing import NDArray


@njit(cache=True, nogil=True)
def find_speckles(
    values: NDArray[np.float32], largest_step: float, smallest_size: int
) -> NDArray[np.bool_]:
    """Mark the pixels of regions that are too small.

    Two neighbours (left, right, above, below) belong to one region when both have a value and
    the values differ by ``largest_step`` or less.

    Args:
        values: float32 (H, W); NaN = no value.
        largest_step: In the unit of ``values``.
        smallest_size: Regions of fewer pixels are marked.

    Returns:
        bool (H, W); False where there is no value.

    Ref: union-find with path halving, R. Sedgewick, K. Wayne, "Algorithms", 4th ed., 1.5.
    """
    height, width = values.shape
    parents = np.arange(height * width, dtype=np.int32)
    for y in range(height):
        for x in range(width):
            here = y * width + x
            if x > 0 and abs(values[y, x] - values[y, x - 1]) <= largest_step:
                parents[here] = parents[here - 1]
            if y > 0 and abs(values[y, x] - values[y - 1, x]) <= largest_step:
                _join(parents, here, here - width)
    sizes = np.zeros(height * width, np.int32)
    for here in range(height * width):
        # A parent has the smaller index: it points to its root already.
        parents[here] = parents[parents[here]]
        sizes[parents[here]] += 1
    small = np.zeros((height, width), np.bool_)
    for y in range(height):
        for x in range(width):
            few = sizes[parents[y * width + x]] < smallest_size
            small[y, x] = few and not np.isnan(values[y, x])
    return small


@njit(cache=True, nogil=True)
def _join(parents: NDArray[np.int32], one: int, other: int) -> None:
    """Give two regions one root: the smaller index."""
    a, b = _root(parents, one), _root(parents, other)
    if a < b:
        parents[b] = a
    else:
        parents[a] = b


@njit(cache=True, nogil=True)
def _root(parents: NDArray[np.int32], node: int) -> int:
    """The root of a node's region; every step halves the path for the next call."""
    while parents[node] != node:
        parents[node] = parents[parents[node]]
        node = parents[node]
    return node
