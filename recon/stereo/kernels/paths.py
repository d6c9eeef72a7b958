"""Costs along the paths of semi-global matching.

Vertical and diagonal paths come from the row before, so every pixel of a row is a lane of its own
and none waits for its neighbour. A row is updated in place: the path from the left goes through it
from right to left, the one from the right from left to right, so that each reads its predecessor
before it is overwritten.

On a horizontal path each pixel needs the path cost of its neighbour, so lanes are candidates: the
costs of a row are transposed, block by block, and the result is transposed back. Both paths are
followed in one loop, so that the processor works on one while it waits for the other. In its first
half a path leaves its costs behind; in the second it averages its own with those of the other.

Paths are averaged instead of summed: a mean of two, rounded up, is one instruction and fits into a
byte. By the order of the means the vertical path weighs twice a diagonal one, and a horizontal path
twice the vertical one.
"""

from __future__ import annotations

from typing import Final, NamedTuple

import numpy as np

from recon.core.kernels.compiled import UInt8, kernel
from recon.stereo.kernels.path_costs import aligned, padded
from recon.stereo.kernels.plane_minima import MARGIN
from recon.stereo.kernels.simd.vectors import (
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

DOWN, UP, WARM_UP = range(3)
"""What `advance` does with the means over the paths: write them (the sweep down), average them with
those of the sweep down (the sweep up), or nothing (rows in which paths only start)."""

STRAIGHT, FROM_LEFT, FROM_RIGHT = range(3)  # the paths of a sweep: vertical, and diagonal
TOGETHER: Final = 16  # candidates done for some columns: what they share stays in registers


class Paths(NamedTuple):
    """The candidates, and the penalties for changing between them along a path."""

    ndisp: int  # number of candidates
    minimum: int  # disparity of candidate 0, pixels
    p1: int  # penalty for a change by one candidate
    p2: int  # penalty for any larger change; `Window.top` + P1 + P2 is at most 254
    p2_at_edge: int  # P2 where the grey level changes by more than ``edge``
    edge: int  # grey levels
    overlap: int  # rows above and below a block in which its paths start
    side_overlap: int  # columns beside a band in which its paths start


class PathRow(NamedTuple):
    """Path costs of one row of C columns; the next row overwrites them."""

    #: (3, P + 2, MARGIN + C + MARGIN), of the paths `STRAIGHT`, `FROM_LEFT` and `FROM_RIGHT`.
    #: The first and the last candidate are dummies, too costly to change from.
    costs: UInt8
    #: (2, 3, MARGIN + C + MARGIN), lowest cost over all candidates of each path, in the row
    #: before and in this one.
    lowest: UInt8
    #: (3, C), previous cost of the candidate below the group being done, which that group has
    #: already overwritten.
    below: UInt8
    limits: UInt8  # (3, C), lowest previous cost plus P2: no way costs more


def begin(paths: Paths, row: PathRow) -> None:
    """Start all paths: every cost is 0, except those of the dummies."""
    row.costs[:] = 0
    row.costs[:, 0] = row.costs[:, -1] = np.uint8(255 - paths.p1)
    row.lowest[:] = row.limits[:] = 0


@kernel
def advance(
    costs: UInt8,
    grey: UInt8,
    before: UInt8,
    paths: Paths,
    row: PathRow,
    means: UInt8,
    along: UInt8,
    stage: int,
) -> None:
    """Advance the paths of a sweep by one row, from the row of grey levels ``before``.

    ``costs`` is uint8 (P, C). The means over the paths, uint8 (P, MARGIN + C + MARGIN), are written
    (stage DOWN), averaged with those of this sweep and of the horizontal paths ``along``, uint8
    (Q, C) (UP), or left alone (WARM_UP).
    """
    lowest, now = row.lowest[0], row.lowest[1]
    width, columns, beyond = grey.size, costs.shape[1], MARGIN + grey.size
    for n, side in enumerate((0, -1, 1)):
        first, end = max(-side, 0), max(min(width - side, width), 0)
        beside = lowest[n, MARGIN + first + side : MARGIN + end + side]
        others = before[first + side : end + side]
        _set_limits(grey[first:end], others, beside, paths, row.limits[n, first:end])
    now[:, MARGIN : MARGIN + columns] = np.uint8(255)
    row.below[:] = np.uint8(255 - paths.p1)
    for first in range(0, costs.shape[0], TOGETHER):
        end = min(first + TOGETHER, costs.shape[0])
        _advance_from_right(costs, first, end, paths.p1, row)
        _advance_others(costs, first, end, paths.p1, row, means, along, stage)
        # Beyond the last column the paths from the right start.
        row.costs[FROM_RIGHT, first + 1 : end + 1, beyond] = np.uint8(0)
    now[FROM_RIGHT, beyond] = np.uint8(0)
    lowest[:] = now


@kernel
def _set_limits(grey: UInt8, others: UInt8, lowest: UInt8, paths: Paths, limits: UInt8) -> None:
    """Write a path's lowest cost in the row before, plus P2."""
    edge, p2 = np.uint8(paths.edge), np.uint8(paths.p2)
    p2_at_edge = np.uint8(paths.p2_at_edge)
    for x in range(limits.size):
        jump = p2_between(grey[x], others[x], edge, p2, p2_at_edge)
        limits[x] = np.uint8(lowest[x] + jump)


@kernel
def p2_between(
    grey: np.uint8, before: np.uint8, edge: np.uint8, p2: np.uint8, p2_at_edge: np.uint8
) -> np.uint8:
    """Return P2 between two pixels of a path, from their grey levels."""
    step = np.uint8(max(grey, before) - min(grey, before))
    return p2_at_edge if step > edge else p2


@kernel
def next_cost(
    same: Vector, below: Vector, above: Vector, p1: Vector, limit: Vector, low: Vector, cost: Vector
) -> Vector:
    """Return the path cost of a candidate at the next pixel: Hirschmüller 2008, equation 13.

    ``same``, ``below`` and ``above`` are path costs at the pixel before, of the candidate and of
    those beside it; ``low`` is the lowest of all candidates there, which is subtracted to keep
    costs bounded, and ``limit`` that plus P2.
    """
    beside = smaller(below, above) + p1
    return smaller(smaller(same, limit), beside) - low + cost


@kernel
def _advance_from_right(costs: UInt8, first: int, end: int, paths_p1: int, row: PathRow) -> None:
    """Advance some candidates of the path from the right, from left to right."""
    path, lowest, now = row.costs[FROM_RIGHT], row.lowest[0], row.lowest[1]
    p1 = splat(np.uint8(paths_p1))
    for x in range(0, costs.shape[1], LANES):
        here, there = x + MARGIN, x + MARGIN + 1
        low, limit = load_row(lowest, FROM_RIGHT, there), load_row(row.limits, FROM_RIGHT, x)
        fresh, below = load_row(now, FROM_RIGHT, here), load_row(row.below, FROM_RIGHT, x)
        same = load_row(path, first + 1, there)
        for k in range(first, end):
            above = load_row(path, k + 2, there)
            cost = next_cost(same, below, above, p1, limit, low, load_row(costs, k, x))
            store_row(path, k + 1, here, cost)
            fresh, below, same = smaller(fresh, cost), same, above
        store_row(row.below, FROM_RIGHT, x, below)
        store_row(now, FROM_RIGHT, here, fresh)


@kernel
def _advance_others(
    costs: UInt8,
    first: int,
    end: int,
    paths_p1: int,
    row: PathRow,
    means: UInt8,
    along: UInt8,
    stage: int,
) -> None:
    """Advance the other two paths, from right to left, and write the means."""
    left, straight, right = row.costs[FROM_LEFT], row.costs[STRAIGHT], row.costs[FROM_RIGHT]
    lowest, now, p1 = row.lowest[0], row.lowest[1], splat(np.uint8(paths_p1))
    for x in range(costs.shape[1] - LANES, -1, -LANES):
        here, there = x + MARGIN, x + MARGIN - 1
        low, limit = load_row(lowest, FROM_LEFT, there), load_row(row.limits, FROM_LEFT, x)
        fresh, below = load_row(now, FROM_LEFT, here), load_row(row.below, FROM_LEFT, x)
        same = load_row(left, first + 1, there)
        low_0, limit_0 = load_row(lowest, STRAIGHT, here), load_row(row.limits, STRAIGHT, x)
        fresh_0, below_0 = load_row(now, STRAIGHT, here), load_row(row.below, STRAIGHT, x)
        same_0 = load_row(straight, first + 1, here)
        for k in range(first, end):
            above, above_0 = load_row(left, k + 2, there), load_row(straight, k + 2, here)
            pixel = load_row(costs, k, x)
            cost = next_cost(same, below, above, p1, limit, low, pixel)
            cost_0 = next_cost(same_0, below_0, above_0, p1, limit_0, low_0, pixel)
            store_row(left, k + 1, here, cost)
            store_row(straight, k + 1, here, cost_0)
            if stage != WARM_UP:
                middle = mean(cost_0, mean(cost, load_row(right, k + 1, here)))
                if stage == UP:
                    middle = mean(load_row(means, k, here), middle)
                    middle = mean(load_row(along, k, x), middle)
                store_row(means, k, here, middle)
            fresh, below, same = smaller(fresh, cost), same, above
            fresh_0, below_0, same_0 = smaller(fresh_0, cost_0), same_0, above_0
        store_row(row.below, FROM_LEFT, x, below)
        store_row(now, FROM_LEFT, here, fresh)
        store_row(row.below, STRAIGHT, x, below_0)
        store_row(now, STRAIGHT, here, fresh_0)


RIGHTWARD, LEFTWARD = range(2)  # the two paths


class RowScratch(NamedTuple):
    """Scratch memory for a row of C columns and P candidates; Q is P padded to whole vectors."""

    columns: UInt8  # (C, Q), costs of the pixels, transposed; shares its memory with ``means``
    paths: UInt8  # (C, Q), path costs, and in the end their means, transposed
    means: UInt8  # (Q, C), means over both paths
    last: UInt8  # (LANES, C), costs of the candidates that do not fill a vector
    #: (2, LANES + Q + LANES), costs of each path at its present pixel; the margins are too
    #: costly to change from.
    now: UInt8
    #: (Q,), lower bound of the path costs: 0, but for candidates that only pad a vector,
    #: which are as costly as the margins.
    least: UInt8
    steps: UInt8  # (C + 1,), P2 between a column and the one before


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
def follow_row(costs: UInt8, grey: UInt8, paths: Paths, scratch: RowScratch) -> None:
    """Follow the two paths along a row of C columns, and write their means to the scratch.

    ``costs`` is uint8 (P, C); ``grey`` the row of the left image, of at most C columns.
    """
    _set_steps(grey, paths, scratch.steps)
    _transpose_costs(costs, scratch)
    scratch.now[:, LANES:-LANES] = np.uint8(0)
    _follow(grey.size, np.uint8(paths.p1), scratch)
    for x in range(0, costs.shape[1], LANES):
        for k in range(0, scratch.least.size, LANES):
            transpose(scratch.paths, x, k, scratch.means, k, x)


@kernel
def _transpose_costs(costs: UInt8, scratch: RowScratch) -> None:
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
def _set_steps(grey: UInt8, paths: Paths, steps: UInt8) -> None:
    """Write P2 between neighbours; where a path starts there is none."""
    edge, p2 = np.uint8(paths.edge), np.uint8(paths.p2)
    p2_at_edge = np.uint8(paths.p2_at_edge)
    for x in range(1, grey.size):
        steps[x] = p2_between(grey[x], grey[x - 1], edge, p2, p2_at_edge)
    steps[0] = steps[grey.size] = np.uint8(0)


@kernel
def _follow(width: int, p1: np.uint8, scratch: RowScratch) -> None:
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
    x: int, p2: np.uint8, path: int, low: Vector, p1: Vector, scratch: RowScratch, met: bool
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
