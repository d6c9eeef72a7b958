"""Costs along paths, from one row of pixels to the next.

All these paths come from the row before: every pixel of a row is a lane of its own, no minimum is
taken across lanes, and no pixel waits for its neighbour. Those along the row are followed by
`recon.kernels.path_across`. Means of two, rounded up, take the place of sums: one instruction each,
and bytes suffice. A straight path counts twice a diagonal, and one along the row twice that. The
loops are written for `recon.kernels.lanes`; a path from the left is followed from the right end of
a row to its left end, and one from the right the other way, so that the next row can be written
over the one before.
"""

from __future__ import annotations

from typing import Final, NamedTuple

import numpy as np
from numba import njit
from numpy.typing import NDArray

from recon.kernels.lanes import LANES, Lanes, least, load_row, mean, splat, store_row
from recon.kernels.plane_minima import MARGIN

DOWN, UP, ASIDE = range(3)
"""What becomes of the means over paths."""

STRAIGHT, FROM_LEFT, FROM_RIGHT = range(3)
"""Where paths come from."""

SLANT: Final = 1
"""Columns by which paths from the left and from the right step with each row. Where no path goes
along the rows flatter ones are of more use, but with those diagonals are."""

TOGETHER: Final = 16
"""Candidates that are done before the next columns: what they share stays in registers."""


class Paths(NamedTuple):
    """What is searched, and what changes along a path cost.

    Attributes:
        ndisp: Number of candidates.
        minimum: Disparity of candidate 0, pixels.
        small: Penalty of a step of one candidate.
        large: Penalty of any other step; `Window.top` + small + large is at most 254.
        large_at_edge: The same where the grey level changes by more than ``edge``.
        edge: Grey levels.
        overlap: Rows that paths start early.
        side_overlap: Columns that they start early at the sides of a band.
    """

    ndisp: int
    minimum: int
    small: int
    large: int
    large_at_edge: int
    edge: int
    overlap: int
    side_overlap: int


class PathRow(NamedTuple):
    """Path costs of one row; the next row is written over it.

    Attributes:
        costs: uint8 (3, P + 2, MARGIN + C + MARGIN), those of the `STRAIGHT` path, `FROM_LEFT` and
            `FROM_RIGHT`. A candidate on each side lets no path in.
        lowest: uint8 (2, 3, MARGIN + C + MARGIN), the least of each, before and now.
        below: uint8 (3, C), what was the cost of the candidate below those that are being done,
            where each path comes from.
        limits: uint8 (3, C), dearest way to a pixel on each path.
    """

    costs: NDArray[np.uint8]
    lowest: NDArray[np.uint8]
    below: NDArray[np.uint8]
    limits: NDArray[np.uint8]


def begin(paths: Paths, row: PathRow) -> None:
    """Let paths begin: all their costs are 0, but those of the candidates on the sides."""
    row.costs[:] = 0
    row.costs[:, 0] = row.costs[:, -1] = np.uint8(255 - paths.small)
    row.lowest[:] = row.limits[:] = 0


@njit(cache=True, nogil=True)
def advance(
    costs: NDArray[np.uint8],
    grey: NDArray[np.uint8],
    before: NDArray[np.uint8],
    paths: Paths,
    row: PathRow,
    means: NDArray[np.uint8],
    across: NDArray[np.uint8],
    stage: int,
) -> None:
    """Advance the paths of a sweep by one row.

    Args:
        costs: uint8 (P, C), cost of each candidate at each pixel.
        grey: uint8 (W), the row of the left picture.
        before: uint8 (W), the row that the paths come from.
        paths: What changes along a path cost.
        row: Read and written: the path costs.
        means: uint8 (P, MARGIN + C + MARGIN): their means are written (DOWN), or taken into what is
            written (UP), or neither (ASIDE).
        across: uint8 (Q, C), means of the paths along the row, taken in as well (UP).
        stage: DOWN, UP or ASIDE.
    """
    lowest, now = row.lowest[0], row.lowest[1]
    width, columns, beyond = grey.size, costs.shape[1], MARGIN + grey.size
    for n, side in enumerate((0, -SLANT, SLANT)):
        first, end = max(-side, 0), max(min(width - side, width), 0)
        beside = lowest[n, MARGIN + first + side : MARGIN + end + side]
        others = before[first + side : end + side]
        _set_limits(grey[first:end], others, beside, paths, row.limits[n, first:end])
    now[:, MARGIN : MARGIN + columns] = np.uint8(255)
    row.below[:] = np.uint8(255 - paths.small)
    for first in range(0, costs.shape[0], TOGETHER):
        end = min(first + TOGETHER, costs.shape[0])
        _advance_from_right(costs, first, end, paths.small, row)
        _advance_others(costs, first, end, paths.small, row, means, across, stage)
        # Beyond the last column paths begin.
        row.costs[FROM_RIGHT, first + 1 : end + 1, beyond : beyond + SLANT] = np.uint8(0)
    now[FROM_RIGHT, beyond : beyond + SLANT] = np.uint8(0)
    lowest[:] = now


@njit(cache=True, nogil=True)
def _set_limits(
    grey: NDArray[np.uint8],
    others: NDArray[np.uint8],
    lowest: NDArray[np.uint8],
    paths: Paths,
    limits: NDArray[np.uint8],
) -> None:
    """Write the least cost of a path's row before, plus the larger penalty on its way."""
    edge, large = np.uint8(paths.edge), np.uint8(paths.large)
    large_at_edge = np.uint8(paths.large_at_edge)
    for x in range(limits.size):
        step = np.uint8(max(grey[x], others[x]) - min(grey[x], others[x]))
        limits[x] = np.uint8(lowest[x] + (large_at_edge if step > edge else large))


@njit(cache=True, nogil=True)
def onward(
    same: Lanes, below: Lanes, above: Lanes, penalty: Lanes, limit: Lanes, low: Lanes, cost: Lanes
) -> Lanes:
    """Cost of a path's next pixel: of the least of the ways to it, the least before taken off."""
    beside = least(below, above) + penalty
    return least(least(same, limit), beside) - low + cost


@njit(cache=True, nogil=True)
def _advance_from_right(
    costs: NDArray[np.uint8], first: int, end: int, small: int, row: PathRow
) -> None:
    """Advance some candidates of the path from the right, from the left end of the row on."""
    path, lowest, now = row.costs[FROM_RIGHT], row.lowest[0], row.lowest[1]
    penalty = splat(np.uint8(small))
    for x in range(0, costs.shape[1], LANES):
        here, there = x + MARGIN, x + MARGIN + SLANT
        low, limit = load_row(lowest, FROM_RIGHT, there), load_row(row.limits, FROM_RIGHT, x)
        fresh, below = load_row(now, FROM_RIGHT, here), load_row(row.below, FROM_RIGHT, x)
        same = load_row(path, first + 1, there)
        for k in range(first, end):
            above = load_row(path, k + 2, there)
            cost = onward(same, below, above, penalty, limit, low, load_row(costs, k, x))
            store_row(path, k + 1, here, cost)
            fresh, below, same = least(fresh, cost), same, above
        store_row(row.below, FROM_RIGHT, x, below)
        store_row(now, FROM_RIGHT, here, fresh)


@njit(cache=True, nogil=True)
def _advance_others(
    costs: NDArray[np.uint8],
    first: int,
    end: int,
    small: int,
    row: PathRow,
    means: NDArray[np.uint8],
    across: NDArray[np.uint8],
    stage: int,
) -> None:
    """Advance the other two paths, from the right end of the row on, and write the means."""
    left, straight, right = row.costs[FROM_LEFT], row.costs[STRAIGHT], row.costs[FROM_RIGHT]
    lowest, now, penalty = row.lowest[0], row.lowest[1], splat(np.uint8(small))
    for x in range(costs.shape[1] - LANES, -1, -LANES):
        here, there = x + MARGIN, x + MARGIN - SLANT
        low, limit = load_row(lowest, FROM_LEFT, there), load_row(row.limits, FROM_LEFT, x)
        fresh, below = load_row(now, FROM_LEFT, here), load_row(row.below, FROM_LEFT, x)
        same = load_row(left, first + 1, there)
        low_0, limit_0 = load_row(lowest, STRAIGHT, here), load_row(row.limits, STRAIGHT, x)
        fresh_0, below_0 = load_row(now, STRAIGHT, here), load_row(row.below, STRAIGHT, x)
        same_0 = load_row(straight, first + 1, here)
        for k in range(first, end):
            above, above_0 = load_row(left, k + 2, there), load_row(straight, k + 2, here)
            pixel = load_row(costs, k, x)
            cost = onward(same, below, above, penalty, limit, low, pixel)
            cost_0 = onward(same_0, below_0, above_0, penalty, limit_0, low_0, pixel)
            store_row(left, k + 1, here, cost)
            store_row(straight, k + 1, here, cost_0)
            if stage != ASIDE:
                middle = mean(cost_0, mean(cost, load_row(right, k + 1, here)))
                if stage == UP:
                    middle = mean(load_row(means, k, here), middle)
                    middle = mean(load_row(across, k, x), middle)
                store_row(means, k, here, middle)
            fresh, below, same = least(fresh, cost), same, above
            fresh_0, below_0, same_0 = least(fresh_0, cost_0), same_0, above_0
        store_row(row.below, FROM_LEFT, x, below)
        store_row(now, FROM_LEFT, here, fresh)
        store_row(row.below, STRAIGHT, x, below_0)
        store_row(now, STRAIGHT, here, fresh_0)
