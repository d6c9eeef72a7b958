"""Small regions of a disparity map that hang together with nothing around them."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from numba import njit
from numpy.typing import NDArray


class _Runs(NamedTuple):
    """Pixels of a row that hang together: run ``n`` is ``starts[n]`` to ``ends[n] - 1``.

    Room for as many as there are pixels; what is not used is never touched, and costs nothing.

    Attributes:
        starts: int32 (N,), places in the flat map.
        ends: int32 (N,).
        parents: int32 (N,), of the same region and not after it; its own if it is the root.
        sizes: int32 (N,), of a root: the pixels of its region.
    """

    starts: NDArray[np.int32]
    ends: NDArray[np.int32]
    parents: NDArray[np.int32]
    sizes: NDArray[np.int32]


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

    Ref: union-find with path halving, R. Sedgewick, K. Wayne, "Algorithms", 4th ed., 1.5; runs as
    nodes, L. He, Y. Chao, K. Suzuki, "A run-based two-scan labeling algorithm", IEEE Transactions
    on Image Processing 17, 2008.
    """
    height, width = values.shape
    block = np.empty((values.size, 4), np.int32)
    runs = _Runs(block[:, 0], block[:, 1], block[:, 2], block[:, 3])
    # Of each column: its run in the row above and in this one.
    above, here = np.empty(width, np.int32), np.empty(width, np.int32)
    count = 0
    for y in range(height):
        above, here = here, above
        count = _cut_row(values, y, np.float32(largest_step), runs, count, here)
        if y > 0:
            _join_rows(values, y, np.float32(largest_step), runs.parents, above, here)
    small = np.zeros((height, width), np.bool_)
    _mark_small(runs, count, smallest_size, small.reshape(-1))
    return small


@njit(cache=True, nogil=True)
def _cut_row(
    values: NDArray[np.float32],
    y: int,
    step: np.float32,
    runs: _Runs,
    count: int,
    here: NDArray[np.int32],
) -> int:
    """Append the runs of a row to the ``count`` there are; return how many there are then."""
    row, place = values[y], y * values.shape[1]
    previous = np.float32(np.nan)
    for x in range(row.size):
        value, continues = row[x], abs(row[x] - previous) <= step
        previous = value
        if np.isnan(value):
            continue
        if not continues:
            runs.starts[count], runs.parents[count], runs.sizes[count] = place + x, count, 0
            count += 1
        runs.ends[count - 1], here[x] = place + x + 1, count - 1
    return count


@njit(cache=True, nogil=True)
def _join_rows(
    values: NDArray[np.float32],
    y: int,
    step: np.float32,
    parents: NDArray[np.int32],
    above: NDArray[np.int32],
    here: NDArray[np.int32],
) -> None:
    """Join the runs of row ``y`` with those of the row above."""
    last_here, last_above = -1, -1
    for x in range(here.size):
        # Along two runs that touch, one join does. No comparison with NaN is true.
        touch = abs(values[y, x] - values[y - 1, x]) <= step
        if touch and (here[x] != last_here or above[x] != last_above):
            last_here, last_above = here[x], above[x]
            _join(parents, last_here, last_above)


@njit(cache=True, nogil=True)
def _mark_small(runs: _Runs, count: int, smallest_size: int, small: NDArray[np.bool_]) -> None:
    """Mark the runs of regions of fewer pixels."""
    parents = runs.parents
    for run in range(count):
        # A parent comes before its child: it points to its root already.
        parents[run] = parents[parents[run]]
        runs.sizes[parents[run]] += runs.ends[run] - runs.starts[run]
    for run in range(count):
        if runs.sizes[parents[run]] < smallest_size:
            small[runs.starts[run] : runs.ends[run]] = True


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
