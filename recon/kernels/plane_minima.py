"""The best candidate of each pixel of a row, from costs that lie candidate by candidate.

The same choice as `recon.kernels.minima` makes, for rows (candidates, W) of uint8: every pixel is
a lane, and a candidate is compared with the best so far of all of them.
"""

from __future__ import annotations

from typing import Final, NamedTuple

import numpy as np
from numba import njit
from numpy.typing import NDArray

from recon.kernels.lanes import LANES, least, load_row, splat, store_row, where_less
from recon.kernels.minima import NO_COST, Minima
from recon.kernels.path_costs import aligned, padded

NONE: Final = 255
"""Stands for the cost of a candidate that does not exist; real costs stay below it."""

MARGIN: Final = LANES
"""Columns on each side of a row of costs, where no candidate exists."""

BLOCK: Final = 256
"""So many candidates are told apart by a byte."""

PARTS: Final = 8
"""What `Minima.costs` count of one step of these costs."""

LOWEST, WHICH, BEFORE, AFTER, ASIDE, EARLIER, LAST, PRIOR, SETTLED = range(9)
"""What is known of a column: its lowest cost, the place of that candidate in its block, the costs
before and after it, the lowest two or more candidates away, the lowest but for the last, the last,
the lowest before the last, the lowest of the blocks before."""


class Band(NamedTuple):
    """Columns of the left view.

    Attributes:
        start: The first whose costs there are.
        end: The column after the last.
        first: The first that is wanted.
        last: The column after the last.
    """

    start: int
    end: int
    first: int
    last: int


class Best(NamedTuple):
    """Room for the choice of rows of bands of C columns, of a picture of W columns.

    Attributes:
        left: uint8 (9, C), what is known of the columns of the left view, `LOWEST` to `SETTLED`.
        left_which: uint16 (C), candidate of the lowest cost.
        right: uint8 (9, at least W), the same of the right view, of which some is used.
        right_lowest: uint8 (N, at least W), lowest cost of N rows of the right view, among the
            bands that were done.
    """

    left: NDArray[np.uint8]
    left_which: NDArray[np.uint16]
    right: NDArray[np.uint8]
    right_lowest: NDArray[np.uint8]


def empty_best(columns: int, width: int, rows: int) -> Best:
    """Room for `choose_row`, for so many rows."""
    right_lowest = aligned((rows, padded(width)))
    right_lowest[:] = NONE
    return Best(
        aligned((9, columns)),
        aligned((columns,), np.uint16),
        aligned((9, padded(width))),
        right_lowest,
    )


@njit(cache=True, nogil=True)
def choose_row(
    costs: NDArray[np.uint8],
    minimum: int,
    y: int,
    place: int,
    band: Band,
    best: Best,
    minima: Minima,
) -> None:
    """Choose the best candidate of each pixel of a row of a band, in both views.

    Candidates whose right pixel lies outside the picture do not exist; of equal costs the
    smaller candidate wins. The bands of a row are done from left to right.

    Args:
        costs: uint8 (P, MARGIN + C + MARGIN), costs of the candidates, below `NONE`; the margins
            are `NONE`. Where a candidate does not exist or is not wanted, `NONE` is written.
        minimum: Disparity of candidate 0, pixels.
        y: The row.
        place: The row, of those that ``best`` is for.
        band: The columns.
        best: Room, and what is known of the right view.
        minima: Written: what is wanted of the row; costs are multiplied by `PARTS`. Right winners
            are kept unless they are beaten.
    """
    ndisp, width = costs.shape[0], minima.winner.shape[1]
    for k in range(ndisp):
        start, end = max(band.first, k + minimum), min(band.last, width + k + minimum)
        _close(costs[k, MARGIN:-MARGIN], start - band.start, end - band.start)
    columns, which = band.end - band.start, minima.right_winner[y]
    best.left[:] = np.uint8(NONE)
    best.left_which[:] = np.uint16(ndisp)
    best.right[LOWEST] = best.right[SETTLED] = best.right_lowest[place]
    for first in range(0, ndisp, BLOCK):
        end = min(first + BLOCK, ndisp)
        _search_left(costs, first, end, best.left)
        _settle(best.left, first, best.left_which[:columns])
        _search_right(costs, minimum, first, end, band, best.right)
        _settle(best.right, first, which)
    best.right_lowest[place] = best.right[LOWEST]
    _write_row(best, ndisp, y, band, minima)


@njit(cache=True, nogil=True)
def _close(costs: NDArray[np.uint8], first: int, end: int) -> None:
    """Mark the columns where a candidate does not exist or is not wanted."""
    costs[: min(first, costs.size)] = np.uint8(NONE)
    costs[max(end, 0) :] = np.uint8(NONE)


@njit(cache=True, nogil=True)
def _search_left(costs: NDArray[np.uint8], first: int, end: int, known: NDArray[np.uint8]) -> None:
    """Compare the candidates of a block with the best before, and keep what is around it."""
    one = splat(np.uint8(1))
    for x in range(0, costs.shape[1] - 2 * MARGIN, LANES):
        lowest, which, index = (
            load_row(known, LOWEST, x),
            load_row(known, WHICH, x),
            splat(np.uint8(0)),
        )
        before, after, aside = (
            load_row(known, BEFORE, x),
            load_row(known, AFTER, x),
            load_row(known, ASIDE, x),
        )
        earlier, last, prior = (
            load_row(known, EARLIER, x),
            load_row(known, LAST, x),
            load_row(known, PRIOR, x),
        )
        for k in range(first, end):
            cost = load_row(costs, k, x + MARGIN)
            # Beside the best that was found last is not aside of it.
            aside = where_less(last, prior, aside, least(aside, cost))
            aside = where_less(cost, lowest, earlier, aside)
            after = where_less(last, prior, cost, after)
            before = where_less(cost, lowest, last, before)
            which = where_less(cost, lowest, index, which)
            earlier, last, prior = least(earlier, last), cost, lowest
            lowest, index = least(lowest, cost), index + one
        store_row(known, LOWEST, x, lowest)
        store_row(known, WHICH, x, which)
        store_row(known, BEFORE, x, before)
        store_row(known, AFTER, x, after)
        store_row(known, ASIDE, x, aside)
        store_row(known, EARLIER, x, earlier)
        store_row(known, LAST, x, last)
        store_row(known, PRIOR, x, prior)


@njit(cache=True, nogil=True)
def _search_right(
    costs: NDArray[np.uint8],
    minimum: int,
    first: int,
    end: int,
    band: Band,
    known: NDArray[np.uint8],
) -> None:
    """Compare the candidates of a block with the best before, for columns of the right view."""
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
            lowest, index = least(lowest, cost), index + one
        store_row(known, LOWEST, x, lowest)
        store_row(known, WHICH, x, which)


@njit(cache=True, nogil=True)
def _settle(known: NDArray[np.uint8], first: int, which: NDArray[np.uint16]) -> None:
    """Take over the candidates of a block that are better than those of the blocks before."""
    lowest, settled, place = known[LOWEST], known[SETTLED], known[WHICH]
    for x in range(which.size):
        here = np.uint16(np.uint16(place[x]) + np.uint16(first))
        which[x] = here if lowest[x] < settled[x] else which[x]
        settled[x] = lowest[x]


@njit(cache=True, nogil=True)
def _write_row(best: Best, ndisp: int, y: int, band: Band, minima: Minima) -> None:
    """Write the winners of the left view, their costs and those around them."""
    winner, costs = minima.winner[y, band.first : band.last], minima.costs[:, y]
    winner[:] = best.left_which[band.first - band.start : band.last - band.start]
    for place, known in enumerate((LOWEST, BEFORE, AFTER, ASIDE)):
        found = best.left[known, band.first - band.start : band.last - band.start]
        _write_costs(found, costs[place, band.first : band.last])
    last, after = np.uint16(ndisp - 1), costs[2, band.first : band.last]
    for x in range(winner.size):
        after[x] = after[x] if winner[x] < last else np.uint16(NO_COST)


@njit(cache=True, nogil=True)
def _write_costs(known: NDArray[np.uint8], costs: NDArray[np.uint16]) -> None:
    """Write costs as `Minima` has them."""
    for x in range(costs.size):
        parts = np.uint16(np.uint16(known[x]) * np.uint16(PARTS))
        costs[x] = np.uint16(NO_COST) if known[x] == np.uint8(NONE) else parts
