"""Costs along the vertical and diagonal paths, from one row of pixels to the next.

All three paths of a sweep come from the row before, so every pixel of a row is a lane of its own
and no pixel waits for its neighbour. The horizontal paths, where each does, are in
`recon.stereo.kernels.path_along`.

Paths are averaged instead of summed: a mean of two, rounded up, is one instruction and fits into a
byte. By the order of the means the vertical path weighs twice a diagonal one, and a horizontal path
twice the vertical one.

A row is updated in place: the path from the left goes through it from right to left, and the one
from the right from left to right, so that each reads its predecessor before it is overwritten.
"""

from __future__ import annotations

from typing import Final, NamedTuple

import numpy as np
from numpy.typing import NDArray

from recon.core.kernels.compiled import kernel
from recon.stereo.kernels.plane_minima import MARGIN
from recon.stereo.kernels.simd import (
    LANES,
    Vector,
    load_row,
    mean,
    smaller,
    splat,
    store_row,
)

DOWN, UP, WARM_UP = range(3)
"""What `advance` does with the means over the paths: write them (the sweep down), average them with
those of the sweep down (the sweep up), or nothing (rows in which paths only start)."""

STRAIGHT, FROM_LEFT, FROM_RIGHT = range(3)
"""The paths of a sweep: vertical, and diagonal from either side."""

TOGETHER: Final = 16
"""Candidates done for some columns before the next columns: what they share stays in registers."""


class Paths(NamedTuple):
    """The candidates, and the penalties for changing between them along a path.

    Attributes:
        ndisp: Number of candidates.
        minimum: Disparity of candidate 0, pixels.
        p1: Penalty for a change by one candidate.
        p2: Penalty for any larger change; `Window.top` + P1 + P2 is at most 254.
        p2_at_edge: P2 where the grey level changes by more than ``edge``.
        edge: Grey levels.
        overlap: Rows above and below a block in which its paths start.
        side_overlap: Columns beside a band in which its paths start.
    """

    ndisp: int
    minimum: int
    p1: int
    p2: int
    p2_at_edge: int
    edge: int
    overlap: int
    side_overlap: int


class PathRow(NamedTuple):
    """Path costs of one row of C columns; the next row overwrites them.

    Attributes:
        costs: uint8 (3, P + 2, MARGIN + C + MARGIN), of the paths `STRAIGHT`, `FROM_LEFT` and
            `FROM_RIGHT`. The first and the last candidate are dummies, too costly to change from.
        lowest: uint8 (2, 3, MARGIN + C + MARGIN), lowest cost over all candidates of each path, in
            the row before and in this one.
        below: uint8 (3, C), previous cost of the candidate below the group being done, which that
            group has already overwritten.
        limits: uint8 (3, C), lowest previous cost plus P2: no way costs more.
    """

    costs: NDArray[np.uint8]
    lowest: NDArray[np.uint8]
    below: NDArray[np.uint8]
    limits: NDArray[np.uint8]


def begin(paths: Paths, row: PathRow) -> None:
    """Start all paths: every cost is 0, except those of the dummies."""
    row.costs[:] = 0
    row.costs[:, 0] = row.costs[:, -1] = np.uint8(255 - paths.p1)
    row.lowest[:] = row.limits[:] = 0


@kernel
def advance(
    costs: NDArray[np.uint8],
    grey: NDArray[np.uint8],
    before: NDArray[np.uint8],
    paths: Paths,
    row: PathRow,
    means: NDArray[np.uint8],
    along: NDArray[np.uint8],
    stage: int,
) -> None:
    """Advance the paths of a sweep by one row.

    Args:
        costs: uint8 (P, C), cost of each candidate at each pixel.
        grey: uint8 (W), the row of the left image.
        before: uint8 (W), the row that the paths come from.
        paths: Candidates and penalties.
        row: Path costs of the row before; those of this row are written.
        means: uint8 (P, MARGIN + C + MARGIN), means over the paths; written (DOWN), averaged with
            those of this sweep (UP), or left alone (WARM_UP).
        along: uint8 (Q, C), means over the horizontal paths; averaged in, too (UP).
        stage: DOWN, UP or WARM_UP.
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
def _set_limits(
    grey: NDArray[np.uint8],
    others: NDArray[np.uint8],
    lowest: NDArray[np.uint8],
    paths: Paths,
    limits: NDArray[np.uint8],
) -> None:
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
    same: Vector,
    below: Vector,
    above: Vector,
    p1: Vector,
    limit: Vector,
    low: Vector,
    cost: Vector,
) -> Vector:
    """Return the path cost of a candidate at the next pixel: Hirschmüller 2008, equation 13.

    Args:
        same: Path costs of the candidate at the pixel before.
        below: Those of the candidate before it.
        above: Those of the candidate after it.
        p1: The penalty for a change by one candidate.
        limit: Lowest path cost of all candidates there, plus P2.
        low: That lowest cost, which is subtracted to keep costs bounded.
        cost: Costs of the candidate at the next pixel.
    """
    beside = smaller(below, above) + p1
    return smaller(smaller(same, limit), beside) - low + cost


@kernel
def _advance_from_right(
    costs: NDArray[np.uint8], first: int, end: int, paths_p1: int, row: PathRow
) -> None:
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
    costs: NDArray[np.uint8],
    first: int,
    end: int,
    paths_p1: int,
    row: PathRow,
    means: NDArray[np.uint8],
    along: NDArray[np.uint8],
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
