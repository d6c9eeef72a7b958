"""The best candidate of each pixel of a row, from costs that lie candidate by candidate.

The same choice as `recon.kernels.minima` makes, for rows (candidates, W) of uint8: every pixel is
a lane, and a candidate is compared with the best so far of all of them.
"""

from __future__ import annotations

from typing import Final, NamedTuple

import numpy as np
from numba import njit
from numpy.typing import NDArray

from recon.kernels.minima import NO_COST, Minima
from recon.kernels.path_costs import aligned

NONE: Final = 255
"""Stands for the cost of a candidate that does not exist; real costs stay below it."""

BLOCK: Final = 256
"""So many candidates are told apart by the lower byte of a key."""

PARTS: Final = 8
"""What `Minima.costs` count of one step of these costs."""


class Best(NamedTuple):
    """Room for the choice of a row of C columns and P candidates.

    Attributes:
        keys: uint16 (C + P), of each column 256 times the lowest cost among a block of candidates,
            plus its place in the block.
        left: uint8 (C), lowest cost in the left view.
        left_which: uint16 (C), its candidate.
        aside: uint8 (C), lowest cost two or more candidates away.
        right: uint8 (C + P), lowest cost in the right view; right column ``x - minimum - k``
            stands at ``x - k + P``.
        right_which: uint16 (C + P), its candidate.
    """

    keys: NDArray[np.uint16]
    left: NDArray[np.uint8]
    left_which: NDArray[np.uint16]
    aside: NDArray[np.uint8]
    right: NDArray[np.uint8]
    right_which: NDArray[np.uint16]


def empty_best(columns: int, candidates: int) -> Best:
    """Room for `choose_rows`."""
    return Best(
        aligned((columns + candidates,), np.uint16),
        aligned((columns,)),
        aligned((columns,), np.uint16),
        aligned((columns,)),
        aligned((columns + candidates,)),
        aligned((columns + candidates,), np.uint16),
    )


@njit(cache=True, nogil=True)
def choose_rows(
    costs: NDArray[np.uint8],
    ndisp: int,
    minimum: int,
    first: int,
    end: int,
    best: Best,
    minima: Minima,
) -> None:
    """Choose the best candidate of each pixel of some rows, in both views.

    Candidates whose right pixel lies outside the picture do not exist; of equal costs the
    smaller candidate wins.

    Args:
        costs: uint8 (N, P, C), costs of the candidates, below `NONE`; row ``y`` is at place
            ``y % N``. Where a candidate does not exist, `NONE` is written.
        ndisp: Number of candidates, at most P.
        minimum: Disparity of candidate 0, pixels.
        first: First row to do.
        end: The row after the last.
        best: Room.
        minima: Written: the rows; costs are multiplied by `PARTS`.
    """
    for y in range(first, end):
        _choose_row(costs[y % costs.shape[0]], ndisp, minimum, y, best, minima)


@njit(cache=True, nogil=True)
def _choose_row(
    costs: NDArray[np.uint8], ndisp: int, minimum: int, y: int, best: Best, minima: Minima
) -> None:
    width = minima.winner.shape[1]
    for k in range(ndisp):
        _close(costs, k, max(0, k + minimum), min(width, width + k + minimum))
    _choose(costs, ndisp, 0, best.keys, best.left, best.left_which)
    _choose(costs, ndisp, 1, best.keys, best.right, best.right_which)
    best.aside[:] = np.uint8(NONE)
    for k in range(ndisp):
        _take_aside(costs, k, best.left_which, best.aside)
    _write_row(costs, ndisp, y, best, minima)
    for x in range(width):
        place = x + minimum + costs.shape[0]
        inside = 0 <= place < best.right.size
        minima.right_winner[y, x] = best.right_which[place] if inside else np.uint16(ndisp)


@njit(cache=True, nogil=True)
def _close(costs: NDArray[np.uint8], k: int, first: int, end: int) -> None:
    """Mark the columns where a candidate does not exist."""
    for x in range(min(first, costs.shape[1])):
        costs[k, x] = np.uint8(NONE)
    for x in range(max(end, 0), costs.shape[1]):
        costs[k, x] = np.uint8(NONE)


@njit(cache=True, nogil=True)
def _choose(
    costs: NDArray[np.uint8],
    ndisp: int,
    view: int,
    keys: NDArray[np.uint16],
    lowest: NDArray[np.uint8],
    which: NDArray[np.uint16],
) -> None:
    """Find the lowest costs of the left view (0) or the right one (1), and their candidates."""
    lowest[:] = np.uint8(NONE)
    which[:] = np.uint16(ndisp)
    for first in range(0, ndisp, BLOCK):
        keys[:] = np.uint16(NO_COST)
        for k in range(first, min(first + BLOCK, ndisp)):
            _take(costs, k, k - first, keys[view * (costs.shape[0] - k) :])
        for x in range(lowest.size):
            cost = np.uint8(keys[x] >> np.uint16(8))
            place = np.uint16(np.uint16(keys[x] & np.uint16(BLOCK - 1)) + np.uint16(first))
            which[x] = place if cost < lowest[x] else which[x]
            lowest[x] = min(lowest[x], cost)


@njit(cache=True, nogil=True)
def _take(costs: NDArray[np.uint8], k: int, place: int, keys: NDArray[np.uint16]) -> None:
    """Compare a candidate with the best so far: of equal costs the smaller place has the key."""
    index, eight = np.uint16(place), np.uint16(8)
    for x in range(costs.shape[1]):
        key = np.uint16(np.uint16(np.uint16(costs[k, x]) << eight) | index)
        keys[x] = min(keys[x], key)


@njit(cache=True, nogil=True)
def _take_aside(
    costs: NDArray[np.uint8], k: int, which: NDArray[np.uint16], aside: NDArray[np.uint8]
) -> None:
    """Compare a candidate with the best so far that is not beside the winner."""
    after = np.uint16(k + 1)
    for x in range(costs.shape[1]):
        cost, other = costs[k, x], aside[x]
        # Above the winner plus one the difference wraps round to a large number.
        far = np.uint16(after - which[x]) > np.uint16(2)
        aside[x] = min(other, cost) if far else other


@njit(cache=True, nogil=True)
def _write_row(costs: NDArray[np.uint8], ndisp: int, y: int, best: Best, minima: Minima) -> None:
    """Write the winners of the left view, their costs and those around them."""
    for x in range(minima.winner.shape[1]):
        k = np.int64(best.left_which[x])
        minima.winner[y, x] = np.uint16(k)
        minima.costs[0, y, x] = _in_parts(best.left[x])
        minima.costs[3, y, x] = _in_parts(best.aside[x])
        minima.costs[1, y, x] = _in_parts(costs[k - 1, x] if 0 < k < ndisp else np.uint8(NONE))
        minima.costs[2, y, x] = _in_parts(costs[k + 1, x] if k + 1 < ndisp else np.uint8(NONE))


@njit(cache=True, nogil=True)
def _in_parts(cost: np.uint8) -> np.uint16:
    """A cost as `Minima` has it."""
    parts: np.uint16 = np.uint16(np.uint16(cost) * np.uint16(PARTS))
    return np.uint16(NO_COST) if cost == np.uint8(NONE) else parts
