"""Costs along a row of pixels, from both of its ends.

Each pixel waits for its neighbour here, so lanes are candidates: a row of costs is transposed,
block by block, and so is what comes of it. Both paths are followed in one loop, so that one goes on
while the other waits: each meets, in the second half of its way, what the other left in the first.

Ref: as `recon.kernels.semi_global`.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from numba import njit
from numpy.typing import NDArray

from recon.kernels.lanes import (
    LANES,
    Lanes,
    least,
    load,
    load_row,
    mean,
    most,
    put_after,
    put_before,
    splat,
    spread_lowest,
    store_row,
)
from recon.kernels.path_costs import aligned, padded
from recon.kernels.path_rows import Paths, onward
from recon.kernels.squares import transpose

RIGHTWARD, LEFTWARD = range(2)
"""Where paths go."""


class Across(NamedTuple):
    """What a row of C columns and P candidates is worked on in; Q is P padded to vectors.

    Attributes:
        columns: uint8 (C, Q), costs of the pixels, transposed.
        paths: uint8 (C, Q), costs of the paths, transposed.
        means: uint8 (Q, C), means over both paths.
        last: uint8 (LANES, C), costs of the candidates that do not fill a vector.
        now: uint8 (2, LANES + Q + LANES), costs of each path at the pixel that it is at; there is
            no way in from the sides.
        floors: uint8 (Q,), least path cost of each candidate: candidates that fill up a vector are
            as dear as the sides.
        steps: uint8 (C + 1,), the larger penalty between a column and the one before.
    """

    columns: NDArray[np.uint8]
    paths: NDArray[np.uint8]
    means: NDArray[np.uint8]
    last: NDArray[np.uint8]
    now: NDArray[np.uint8]
    floors: NDArray[np.uint8]
    steps: NDArray[np.uint8]


def empty_across(columns: int, paths: Paths) -> Across:
    """Room for `follow_row`; columns is a multiple of `LANES`."""
    candidates = padded(paths.ndisp)
    closed = np.uint8(255 - paths.small)
    now, floors = aligned((2, LANES + candidates + LANES)), aligned((candidates,))
    now[:] = closed
    floors[paths.ndisp :] = closed
    shape = (columns, candidates)
    # The means are written when the costs have been read.
    transposed = aligned(shape)
    return Across(
        transposed,
        aligned(shape),
        transposed.reshape(shape[::-1]),
        aligned((LANES, columns)),
        now,
        floors,
        aligned((columns + 1,)),
    )


@njit(cache=True, nogil=True)
def follow_row(
    costs: NDArray[np.uint8], grey: NDArray[np.uint8], paths: Paths, across: Across
) -> None:
    """Follow the two paths along a row, and write their means.

    Args:
        costs: uint8 (P, C), cost of each candidate at each pixel.
        grey: uint8 (W), the row of the left picture, of at most C columns.
        paths: What changes along a path cost.
        across: Room; its means are written.
    """
    _set_steps(grey, paths, across.steps)
    _transpose_costs(costs, across)
    across.now[:, LANES:-LANES] = np.uint8(0)
    _follow(grey.size, np.uint8(paths.small), across)
    for x in range(0, costs.shape[1], LANES):
        for k in range(0, across.floors.size, LANES):
            transpose(across.paths, x, k, across.means, k, x)


@njit(cache=True, nogil=True)
def _transpose_costs(costs: NDArray[np.uint8], across: Across) -> None:
    """Write the costs column by column."""
    ndisp, columns = costs.shape
    whole = ndisp // LANES * LANES
    for k in range(0, whole, LANES):
        for x in range(0, columns, LANES):
            transpose(costs, k, x, across.columns, x, k)
    if whole == ndisp:
        return
    for k in range(whole, ndisp):
        for x in range(0, columns, LANES):
            store_row(across.last, k - whole, x, load_row(costs, k, x))
    for x in range(0, columns, LANES):
        transpose(across.last, 0, x, across.columns, x, whole)


@njit(cache=True, nogil=True)
def _set_steps(grey: NDArray[np.uint8], paths: Paths, steps: NDArray[np.uint8]) -> None:
    """Write the larger penalty between neighbours; paths begin with none."""
    edge, large = np.uint8(paths.edge), np.uint8(paths.large)
    large_at_edge = np.uint8(paths.large_at_edge)
    for x in range(1, grey.size):
        step = np.uint8(max(grey[x], grey[x - 1]) - min(grey[x], grey[x - 1]))
        steps[x] = large_at_edge if step > edge else large
    steps[0] = steps[grey.size] = np.uint8(0)


@njit(cache=True, nogil=True)
def _follow(width: int, small: np.uint8, across: Across) -> None:
    """Follow both paths from end to end."""
    right = left = splat(np.uint8(0))
    penalty, half = splat(small), width // 2
    for x in range(half):
        right = _step(x, across.steps[x], RIGHTWARD, right, penalty, across, False)
        back = width - 1 - x
        left = _step(back, across.steps[back + 1], LEFTWARD, left, penalty, across, False)
    if width % 2:
        right = _step(half, across.steps[half], RIGHTWARD, right, penalty, across, False)
        left = _step(half, across.steps[half + 1], LEFTWARD, left, penalty, across, True)
    for x in range(width - half, width):
        right = _step(x, across.steps[x], RIGHTWARD, right, penalty, across, True)
        back = width - 1 - x
        left = _step(back, across.steps[back + 1], LEFTWARD, left, penalty, across, True)


@njit(cache=True, nogil=True, inline="always")
def _step(
    x: int,
    large: np.uint8,
    path: int,
    low: Lanes,
    penalty: Lanes,
    across: Across,
    met: bool,
) -> Lanes:
    """Advance a path to a column, and return its least cost, in each lane."""
    limit, fresh = low + splat(large), splat(np.uint8(255))
    before, same = load_row(across.now, path, 0), load_row(across.now, path, LANES)
    last = across.floors.size - LANES
    for k in range(0, last, LANES):
        after = load_row(across.now, path, k + 2 * LANES)
        below, above = put_before(same, before), put_after(same, after)
        cost = onward(same, below, above, penalty, limit, low, load_row(across.columns, x, k))
        _keep(cost, path, x, k, across, met)
        fresh, before, same = least(fresh, cost), same, after
    below = put_before(same, before)
    above = put_after(same, load_row(across.now, path, last + 2 * LANES))
    cost = onward(same, below, above, penalty, limit, low, load_row(across.columns, x, last))
    cost = most(cost, load(across.floors, last))
    _keep(cost, path, x, last, across, met)
    return spread_lowest(least(fresh, cost))


@njit(cache=True, nogil=True, inline="always")
def _keep(cost: Lanes, path: int, x: int, k: int, across: Across, met: bool) -> None:
    """Write what a path costs, and the mean where the other path has been."""
    store_row(across.now, path, k + LANES, cost)
    if met:
        cost = mean(cost, load_row(across.paths, x, k))
    store_row(across.paths, x, k, cost)
