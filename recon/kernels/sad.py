"""Sums of absolute differences over a window, and the best candidate of each pixel.

How it is fast: the candidates of a pixel lie side by side, and all that costs time is done for
`LANES` of them by one instruction or two (`recon.kernels.lanes`). A window is made of two halves
(`recon.kernels.half_windows`), each summed up once for two rows. The least cost is kept of each
lane while the costs are made, so they are never written down; only at the end the lanes of a pixel
are compared. Rows are done in blocks of columns whose halves stay in a core's own cache.

Two halves that are moved against each other make a window that leans: beside the upright window
it costs one more addition, not one more search.

The twin in plain numpy, `recon.kernels.sad_reference.sad_minima_reference`, says what the
results are.

Ref: K. Mühlmann et al., "Calculating dense disparity maps from color stereo images, an efficient
implementation", IJCV 47, 2002; N. Einecke, J. Eggert, "A multi-block-matching approach for
stereo", IEEE Intelligent Vehicles, 2015 (several windows).
"""

from __future__ import annotations

import numpy as np
from numba import njit
from numpy.typing import NDArray

from recon.kernels.half_windows import (
    RUN,
    Halves,
    Room,
    Search,
    Views,
    existing,
    fill_columns,
    sum_halves,
)
from recon.kernels.lanes import (
    LANES,
    Lanes,
    least,
    load,
    lowest,
    lowest_pair,
    most,
    ramp,
    splat,
    where_less,
)
from recon.kernels.minima import NO_COST, Minima, claim_right


@njit(cache=True, nogil=True)
def sad_minima(
    views: Views, search: Search, first: int, end: int, room: Room, minima: Minima
) -> None:
    """Find the best candidate of each pixel of some rows.

    Candidate ``k`` of a pixel is the disparity ``minimum + k``. Its cost is the sum of
    ``min(|left - right|, cost_cap)`` over both halves of the window (the middle row is in both,
    so it counts twice), the pictures continued by their border pixels; with a lean it is the
    smaller of that and of the same sum where the upper half takes candidate ``k - lean`` and the
    lower ``k + lean``, as on the ground under a camera. Candidates whose right pixel lies outside
    the picture do not exist. Of equal costs the smaller disparity wins. The costs before and
    after the best are those of the window that won, the upright one if both did. A pixel of the
    right view is matched to the left pixel that chose it at the least cost.

    Args:
        views: The pictures, from `lay_out`.
        search: What is searched.
        first: First row to do.
        end: The row after the last. The rows of a call depend on no other call.
        room: Memory from `make_room`; not shared with another thread.
        minima: Written: the rows ``first`` to ``end - 1``.
    """
    start, none = first - search.rows_radius, load(room.none, 0)
    for x0 in range(0, views.width, room.block):
        width = min(room.block, views.width - x0)
        fill_columns(views, search, start, x0, room)
        for y in range(start, end):
            lower = room.halves[(y - start) % len(room.halves)]
            # The half above row y is that below row y - rows_radius, the oldest of the ring.
            upper = room.halves[(y - start + 1) % len(room.halves)]
            halves = Halves(upper, lower, room.places)
            for c in range(0, width, RUN):
                stop = min(c + RUN, width)
                sum_halves(views, search, y, x0, c, stop, room, lower)
                if y >= first:
                    _choose(halves, search, none, y, x0, c, stop, minima)
                    _look_beside(halves, search, y, x0, c, stop, minima)
    for y in range(first, end):
        claim_right(search.ndisp, search.minimum, y, minima)


@njit(cache=True, nogil=True)
def _choose(
    halves: Halves,
    search: Search,
    none: Lanes,
    y: int,
    x0: int,
    start: int,
    end: int,
    minima: Minima,
) -> None:
    """Write the best candidate, its cost and the second best cost, of columns of a block."""
    width, lean = minima.winner.shape[1], search.lean
    step, one, three = splat(np.uint16(LANES)), splat(np.uint16(1)), splat(np.uint16(3))
    for c in range(start, end):
        x, at = np.uint64(x0 + c), c * halves.places + abs(lean)
        first, stop = existing(search, width, x0 + c)
        k, best, which, second = first // LANES * LANES, none, none, none
        numbers = ramp(np.uint16(k))
        if k < first:
            cost = _close(_costs(halves, at + k, lean), none, k, first, stop)
            best, which, second = _offer(cost, numbers, best, which, second)
            k, numbers = k + LANES, numbers + step
        while k + LANES <= stop:
            cost = _costs(halves, at + k, lean)
            best, which, second = _offer(cost, numbers, best, which, second)
            k, numbers = k + LANES, numbers + step
        if k < stop:
            cost = _close(_costs(halves, at + k, lean), none, k, first, stop)
            best, which, second = _offer(cost, numbers, best, which, second)
        lowest_cost, winner = lowest_pair(best, which)
        # Candidates of one lane are far from each other: where its best is the winner, or beside
        # it, its second best is two or more away.
        near = which + one - splat(winner)
        minima.winner[y, x] = winner if lowest_cost != NO_COST else search.ndisp
        minima.costs[0, y, x] = lowest_cost
        minima.costs[3, y, x] = lowest(where_less(near, three, second, best))


@njit(cache=True, nogil=True)
def _offer(
    cost: Lanes, numbers: Lanes, best: Lanes, which: Lanes, second: Lanes
) -> tuple[Lanes, Lanes, Lanes]:
    """What is known of each lane once a candidate of it is offered."""
    which = where_less(cost, best, numbers, which)
    return least(best, cost), which, least(second, most(best, cost))


@njit(cache=True, nogil=True)
def _costs(halves: Halves, at: int, lean: int) -> Lanes:
    """The costs of neighbouring candidates: each that of the better of its two windows."""
    upper, lower = halves.upper, halves.lower
    upright = load(upper, at) + load(lower, at)
    return least(upright, load(upper, at - lean) + load(lower, at + lean))


@njit(cache=True, nogil=True)
def _close(costs: Lanes, none: Lanes, k: int, first: int, end: int) -> Lanes:
    """The costs of candidates ``k`` and on, of which those from ``first`` to ``end - 1`` exist."""
    places = ramp(np.uint16(k)) - splat(np.uint16(first))
    return where_less(places, splat(np.uint16(end - first)), costs, none)


@njit(cache=True, nogil=True)
def _look_beside(
    halves: Halves, search: Search, y: int, x0: int, start: int, end: int, minima: Minima
) -> None:
    """Write the costs before and after each best, from the window that won: a fit mixes no two."""
    upper, lower, lean = halves.upper, halves.lower, search.lean
    for c in range(start, end):
        x, before, after = np.uint64(x0 + c), np.uint16(NO_COST), np.uint16(NO_COST)
        first, stop = existing(search, minima.winner.shape[1], x0 + c)
        k = np.int64(minima.winner[y, x])
        if k < search.ndisp:
            at = c * halves.places + abs(lean) + k
            own = lean if minima.costs[0, y, x] < _cost(upper, lower, at, 0) else 0
            if k > first:
                before = _cost(upper, lower, at - 1, own)
            if k + 1 < stop:
                after = _cost(upper, lower, at + 1, own)
        minima.costs[1, y, x], minima.costs[2, y, x] = before, after


@njit(cache=True, nogil=True)
def _cost(upper: NDArray[np.uint16], lower: NDArray[np.uint16], at: int, lean: int) -> np.uint16:
    """The cost of the window whose halves lean by so many places; unsigned needs no checks."""
    cost: np.uint16 = np.uint16(upper[np.uint64(at - lean)] + lower[np.uint64(at + lean)])
    return cost
