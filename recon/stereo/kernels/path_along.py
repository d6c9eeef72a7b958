"""Costs along the two horizontal paths of a row of pixels.

Each pixel needs the path cost of its neighbour, so lanes are candidates here: the costs of a row
are transposed, block by block, and the result is transposed back. Both paths are followed in one
loop, so that the processor works on one while it waits for the other. In the first half of its way
a path leaves its costs behind; in the second half it averages its own with those of the other.

Ref: as `recon.stereo.kernels.semi_global`.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from recon.core.kernels.compiled import kernel
from recon.stereo.kernels.path_costs import aligned, padded
from recon.stereo.kernels.path_rows import Paths, next_cost, p2_between
from recon.stereo.kernels.simd import (
    LANES,
    Vector,
    broadcast_smallest,
    larger,
    load,
    load_row,
    mean,
    put_after,
    put_before,
    smaller,
    splat,
    store_row,
    transpose,
)

RIGHTWARD, LEFTWARD = range(2)
"""The two paths."""


class RowScratch(NamedTuple):
    """Scratch memory for a row of C columns and P candidates; Q is P padded to whole vectors.

    Attributes:
        columns: uint8 (C, Q), costs of the pixels, transposed; shares its memory with ``means``.
        paths: uint8 (C, Q), path costs, and in the end their means, transposed.
        means: uint8 (Q, C), means over both paths.
        last: uint8 (LANES, C), costs of the candidates that do not fill a vector.
        now: uint8 (2, LANES + Q + LANES), costs of each path at its present pixel; the margins are
            too costly to change from.
        least: uint8 (Q,), lower bound of the path costs: 0, but for candidates that only pad a
            vector, which are as costly as the margins.
        steps: uint8 (C + 1,), P2 between a column and the one before.
    """

    columns: NDArray[np.uint8]
    paths: NDArray[np.uint8]
    means: NDArray[np.uint8]
    last: NDArray[np.uint8]
    now: NDArray[np.uint8]
    least: NDArray[np.uint8]
    steps: NDArray[np.uint8]


def empty_row_scratch(columns: int, paths: Paths) -> RowScratch:
    """Return memory for `follow_row`; columns is a multiple of `LANES`."""
    candidates = padded(paths.ndisp)
    closed = np.uint8(255 - paths.p1)
    now, least = aligned((2, LANES + candidates + LANES)), aligned((candidates,))
    now[:] = closed
    least[paths.ndisp :] = closed
    shape = (columns, candidates)
    # The means are written once the costs have been read.
    transposed = aligned(shape)
    return RowScratch(
        transposed,
        aligned(shape),
        transposed.reshape(shape[::-1]),
        aligned((LANES, columns)),
        now,
        least,
        aligned((columns + 1,)),
    )


@kernel
def follow_row(
    costs: NDArray[np.uint8], grey: NDArray[np.uint8], paths: Paths, scratch: RowScratch
) -> None:
    """Follow the two paths along a row, and write their means.

    Args:
        costs: uint8 (P, C), cost of each candidate at each pixel.
        grey: uint8 (W), the row of the left image, of at most C columns.
        paths: Candidates and penalties.
        scratch: Memory to work in; its ``means`` are the result.
    """
    _set_steps(grey, paths, scratch.steps)
    _transpose_costs(costs, scratch)
    scratch.now[:, LANES:-LANES] = np.uint8(0)
    _follow(grey.size, np.uint8(paths.p1), scratch)
    for x in range(0, costs.shape[1], LANES):
        for k in range(0, scratch.least.size, LANES):
            transpose(scratch.paths, x, k, scratch.means, k, x)


@kernel
def _transpose_costs(costs: NDArray[np.uint8], scratch: RowScratch) -> None:
    """Write the costs column by column."""
    ndisp, columns = costs.shape
    whole = ndisp // LANES * LANES
    for k in range(0, whole, LANES):
        for x in range(0, columns, LANES):
            transpose(costs, k, x, scratch.columns, x, k)
    if whole == ndisp:
        return
    for k in range(whole, ndisp):
        for x in range(0, columns, LANES):
            store_row(scratch.last, k - whole, x, load_row(costs, k, x))
    for x in range(0, columns, LANES):
        transpose(scratch.last, 0, x, scratch.columns, x, whole)


@kernel
def _set_steps(grey: NDArray[np.uint8], paths: Paths, steps: NDArray[np.uint8]) -> None:
    """Write P2 between neighbours; where a path starts there is none."""
    edge, p2 = np.uint8(paths.edge), np.uint8(paths.p2)
    p2_at_edge = np.uint8(paths.p2_at_edge)
    for x in range(1, grey.size):
        steps[x] = p2_between(grey[x], grey[x - 1], edge, p2, p2_at_edge)
    steps[0] = steps[grey.size] = np.uint8(0)


@kernel
def _follow(width: int, p1: np.uint8, scratch: RowScratch) -> None:
    """Follow both paths from end to end."""
    right = left = splat(np.uint8(0))
    step_p1, half = splat(p1), width // 2
    for x in range(half):
        right = _step(x, scratch.steps[x], RIGHTWARD, right, step_p1, scratch, False)
        back = width - 1 - x
        left = _step(back, scratch.steps[back + 1], LEFTWARD, left, step_p1, scratch, False)
    if width % 2:
        right = _step(half, scratch.steps[half], RIGHTWARD, right, step_p1, scratch, False)
        left = _step(half, scratch.steps[half + 1], LEFTWARD, left, step_p1, scratch, True)
    for x in range(width - half, width):
        right = _step(x, scratch.steps[x], RIGHTWARD, right, step_p1, scratch, True)
        back = width - 1 - x
        left = _step(back, scratch.steps[back + 1], LEFTWARD, left, step_p1, scratch, True)


@kernel(inline="always")
def _step(
    x: int,
    p2: np.uint8,
    path: int,
    low: Vector,
    p1: Vector,
    scratch: RowScratch,
    met: bool,
) -> Vector:
    """Advance a path to column ``x``; return its lowest cost there, in each lane.

    ``p2`` is the penalty on the way, ``low`` the lowest cost before, ``met`` whether the
    other path has been in this column.
    """
    limit, fresh = low + splat(p2), splat(np.uint8(255))
    before, same = load_row(scratch.now, path, 0), load_row(scratch.now, path, LANES)
    last = scratch.least.size - LANES
    for k in range(0, last, LANES):
        after = load_row(scratch.now, path, k + 2 * LANES)
        below, above = put_before(same, before), put_after(same, after)
        cost = next_cost(same, below, above, p1, limit, low, load_row(scratch.columns, x, k))
        _keep(cost, path, x, k, scratch, met)
        fresh, before, same = smaller(fresh, cost), same, after
    below = put_before(same, before)
    above = put_after(same, load_row(scratch.now, path, last + 2 * LANES))
    cost = next_cost(same, below, above, p1, limit, low, load_row(scratch.columns, x, last))
    cost = larger(cost, load(scratch.least, last))
    _keep(cost, path, x, last, scratch, met)
    return broadcast_smallest(smaller(fresh, cost))


@kernel(inline="always")
def _keep(cost: Vector, path: int, x: int, k: int, scratch: RowScratch, met: bool) -> None:
    """Store path costs, or their means with those of the other path where it has been."""
    store_row(scratch.now, path, k + LANES, cost)
    if met:
        cost = mean(cost, load_row(scratch.paths, x, k))
    store_row(scratch.paths, x, k, cost)
