"""The best candidate of each pixel of a row, from costs (candidates, W) in uint8.

Every pixel is a lane: one candidate of many pixels is compared with the best so far of each.
"""

from __future__ import annotations

from typing import Final, NamedTuple

import numpy as np

from recon.core.kernels.compiled import UInt8, UInt16, kernel
from recon.stereo.kernels.minima import NO_COST, Minima
from recon.stereo.kernels.path_costs import aligned, padded
from recon.stereo.kernels.simd.vectors import LANES, load_row, smaller, splat, store_row, where_less

NONE: Final = 255  # cost of a candidate that does not exist; real costs stay below it
MARGIN: Final = LANES  # columns on each side of a row of costs, where no candidate exists
BLOCK: Final = 256  # candidates that a byte can number
PARTS: Final = 8  # units of `Minima.costs` per unit of these costs
LOWEST, WHICH, BEFORE, AFTER, SECOND, LAST, PRIOR, EARLIER = range(8)
"""Rows of what is known of a column.

LOWEST is the lowest cost so far and WHICH the number of its candidate in the block; BEFORE and
AFTER are the costs of the candidates beside it, SECOND the lowest cost two or more candidates away.
LAST is the cost of the last candidate, and PRIOR the lowest cost before that one. EARLIER is the
lowest cost of the earlier blocks.
"""


class Band(NamedTuple):
    """Columns of the left view that are done together."""

    start: int  # the first column with costs
    end: int  # the column after the last with costs
    first: int  # the first column that is kept; the others are overlap
    last: int  # the column after the last that is kept


class Best(NamedTuple):
    """The best so far, for bands of C columns of an image of W columns."""

    left: UInt8  # (8, C), what is known of the columns of the left view, `LOWEST` to `EARLIER`
    left_which: UInt16  # (C), candidate of the lowest cost
    #: (8, at least W), as ``left`` for the right view; only `LOWEST`, `WHICH` and `EARLIER`
    #: are used.
    right: UInt8
    #: (N, at least W), lowest cost in N rows of the right view over the bands done so far.
    right_lowest: UInt8


def empty_best(columns: int, width: int, rows: int) -> Best:
    """Return memory for `choose_row`, for so many rows."""
    right_lowest = aligned((rows, padded(width)))
    right_lowest[:] = NONE
    return Best(
        aligned((8, columns)),
        aligned((columns,), np.uint16),
        aligned((8, padded(width))),
        right_lowest,
    )


@kernel
def choose_row(
    costs: UInt8, minimum: int, y: int, place: int, band: Band, best: Best, minima: Minima
) -> None:
    """Choose the best candidate of each pixel of row ``y`` of a band, in both views.

    Candidates whose right pixel lies outside the image do not exist; of equal costs the smaller
    candidate wins. The bands of a row are done from left to right; right winners stay unless they
    are beaten. The costs of `Minima` are these, multiplied by `PARTS`.

    ``costs`` are uint8 (P, MARGIN + C + MARGIN), below `NONE`; the margins are `NONE`, with which
    what does not exist or is not kept is overwritten. ``place`` is the number of the row among
    those of ``best.right_lowest``.
    """
    ndisp, width = costs.shape[0], minima.winner.shape[1]
    for k in range(ndisp):
        start, end = max(band.first, k + minimum), min(band.last, width + k + minimum)
        _close(costs[k, MARGIN:-MARGIN], start - band.start, end - band.start)
    columns, which = band.end - band.start, minima.right_winner[y]
    best.left[:] = np.uint8(NONE)
    best.left_which[:] = np.uint16(ndisp)
    best.right[LOWEST] = best.right[EARLIER] = best.right_lowest[place]
    for first in range(0, ndisp, BLOCK):
        end = min(first + BLOCK, ndisp)
        _search_left(costs, first, end, best.left)
        _merge_block(best.left, first, best.left_which[:columns])
        _search_right(costs, minimum, first, end, band, best.right)
        _merge_block(best.right, first, which)
    best.right_lowest[place] = best.right[LOWEST]
    _write_row(best, ndisp, y, band, minima)


@kernel
def _close(costs: UInt8, first: int, end: int) -> None:
    """Mark the columns outside ``first`` to ``end - 1``."""
    costs[: min(first, costs.size)] = np.uint8(NONE)
    costs[max(end, 0) :] = np.uint8(NONE)


@kernel
def _search_left(costs: UInt8, first: int, end: int, known: UInt8) -> None:
    """Compare a block of candidates with the best so far, and note the costs around it."""
    one = splat(np.uint8(1))
    for x in range(0, costs.shape[1] - 2 * MARGIN, LANES):
        lowest, which = load_row(known, LOWEST, x), load_row(known, WHICH, x)
        before, after = load_row(known, BEFORE, x), load_row(known, AFTER, x)
        second, index = load_row(known, SECOND, x), splat(np.uint8(0))
        last, prior = load_row(known, LAST, x), load_row(known, PRIOR, x)
        for k in range(first, end):
            cost = load_row(costs, k, x + MARGIN)
            # Where the last candidate is the best so far, this one is beside it: no second best.
            second = where_less(last, prior, second, smaller(second, cost))
            second = where_less(cost, lowest, prior, second)
            after = where_less(last, prior, cost, after)
            before = where_less(cost, lowest, last, before)
            which = where_less(cost, lowest, index, which)
            last, prior = cost, lowest
            lowest, index = smaller(lowest, cost), index + one
        store_row(known, LOWEST, x, lowest)
        store_row(known, WHICH, x, which)
        store_row(known, BEFORE, x, before)
        store_row(known, AFTER, x, after)
        store_row(known, SECOND, x, second)
        store_row(known, LAST, x, last)
        store_row(known, PRIOR, x, prior)


@kernel
def _search_right(
    costs: UInt8, minimum: int, first: int, end: int, band: Band, known: UInt8
) -> None:
    """Compare a block of candidates with the best so far, for columns of the right view."""
    one, columns = splat(np.uint8(1)), costs.shape[1] - 2 * MARGIN
    nearest = max(band.first - minimum - end + 1, 0) // LANES * LANES
    farthest = min(band.last - minimum - first, known.shape[1])
    for x in range(nearest, farthest, LANES):
        ahead = x + minimum - band.start
        start, stop = max(first, 1 - LANES - ahead), min(end, columns - ahead)
        lowest, which = load_row(known, LOWEST, x), load_row(known, WHICH, x)
        index = splat(np.uint8(start - first))
        for k in range(start, stop):
            cost = load_row(costs, k, MARGIN + ahead + k)
            which = where_less(cost, lowest, index, which)
            lowest, index = smaller(lowest, cost), index + one
        store_row(known, LOWEST, x, lowest)
        store_row(known, WHICH, x, which)


@kernel
def _merge_block(known: UInt8, first: int, which: UInt16) -> None:
    """Take over the winners of a block that beat those of the blocks before."""
    lowest, earlier, place = known[LOWEST], known[EARLIER], known[WHICH]
    for x in range(which.size):
        here = np.uint16(np.uint16(place[x]) + np.uint16(first))
        which[x] = here if lowest[x] < earlier[x] else which[x]
        earlier[x] = lowest[x]


@kernel
def _write_row(best: Best, ndisp: int, y: int, band: Band, minima: Minima) -> None:
    """Write the winners of the left view, their costs and those around them."""
    winner, costs = minima.winner[y, band.first : band.last], minima.costs[:, y]
    winner[:] = best.left_which[band.first - band.start : band.last - band.start]
    for place, known in enumerate((LOWEST, BEFORE, AFTER, SECOND)):
        found = best.left[known, band.first - band.start : band.last - band.start]
        _write_costs(found, costs[place, band.first : band.last])
    last, after = np.uint16(ndisp - 1), costs[2, band.first : band.last]
    for x in range(winner.size):
        after[x] = after[x] if winner[x] < last else np.uint16(NO_COST)


@kernel
def _write_costs(known: UInt8, costs: UInt16) -> None:
    """Write costs as `Minima` has them."""
    for x in range(costs.size):
        parts = np.uint16(np.uint16(known[x]) * np.uint16(PARTS))
        costs[x] = np.uint16(NO_COST) if known[x] == np.uint8(NONE) else parts
