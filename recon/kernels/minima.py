"""The best candidate of each pixel of a row of costs, in the left view and in the right.

Both come from the same costs, which are read once more while they are still in the cache: so a
left-right check costs one pass instead of a second search.
"""

from __future__ import annotations

from typing import Final, NamedTuple

import numpy as np
from numba import njit
from numpy.typing import NDArray

NO_COST: Final = 65535
"""Stands for the cost of a candidate that does not exist; real costs stay below it."""


class Minima(NamedTuple):
    """What a search finds.

    Attributes:
        winner: uint16 (H, W), best candidate of each pixel of the left view; ndisp = none.
        costs: uint16 (4, H, W), costs of the best, of the ones before and after it, and of the
            best that is at least two candidates away; `NO_COST` = does not exist.
        right_winner: uint16 (H, W), best candidate of each pixel of the right view; ndisp = none.
    """

    winner: NDArray[np.uint16]
    costs: NDArray[np.uint16]
    right_winner: NDArray[np.uint16]


def empty_minima(height: int, width: int) -> Minima:
    """Arrays for a search to write to."""
    return Minima(
        winner=np.empty((height, width), np.uint16),
        costs=np.empty((4, height, width), np.uint16),
        right_winner=np.empty((height, width), np.uint16),
    )


@njit(cache=True, nogil=True)
def left_minima(sums: NDArray[np.uint16], y: int, minimum: int, minima: Minima) -> None:
    """Choose the best candidate of each pixel of row ``y`` of the left view.

    Candidates whose right pixel lies outside the picture do not exist; of equal costs the
    smaller candidate wins.

    Args:
        sums: uint16 (W, ndisp), costs of the candidates of the row, below `NO_COST`.
        y: The row to write to.
        minimum: Disparity of candidate 0, pixels.
        minima: Written: row ``y`` of ``winner`` and ``costs``.
    """
    winner, costs = minima.winner, minima.costs
    width, ndisp = winner.shape[1], sums.shape[1]
    for x in range(width):
        low = max(x - minimum - (width - 1), 0)
        end = min(x - minimum + 1, ndisp)
        if low >= end:
            winner[y, x] = np.uint16(ndisp)
            costs[:, y, x] = np.uint16(NO_COST)
            continue
        here = sums[x]
        lowest = _lowest(here[low:end])
        k = low + _first_equal(here[low:end], lowest)
        winner[y, x] = np.uint16(k)
        costs[0, y, x] = lowest
        costs[1, y, x] = here[k - 1] if k > low else np.uint16(NO_COST)
        costs[2, y, x] = here[k + 1] if k + 1 < end else np.uint16(NO_COST)
        costs[3, y, x] = _lowest_aside(here[low:end], np.uint16(k - low))


@njit(cache=True, nogil=True)
def _lowest(costs: NDArray[np.uint16]) -> np.uint16:
    """Lowest of some costs, `NO_COST` of none."""
    lowest: np.uint16 = np.uint16(NO_COST)
    for k in range(costs.size):
        lowest = min(lowest, costs[k])
    return lowest


@njit(cache=True, nogil=True)
def _lowest_aside(costs: NDArray[np.uint16], place: np.uint16) -> np.uint16:
    """Lowest of the costs that are two or more aside from ``place``; no slice, so one loop."""
    lowest: np.uint16 = np.uint16(NO_COST)
    for k in range(costs.size):
        # Below ``place - 1`` the difference wraps round to a large number.
        aside = np.uint16(np.uint16(np.uint16(k) - place) + np.uint16(1))
        here = costs[k] if aside > np.uint16(2) else np.uint16(NO_COST)
        lowest = min(lowest, here)
    return lowest


@njit(cache=True, nogil=True)
def _first_equal(costs: NDArray[np.uint16], cost: np.uint16) -> int:
    """Index of the first that equals ``cost``; no early exit, so that it vectorises."""
    found = np.uint16(NO_COST)
    for k in range(costs.size):
        here = np.uint16(k) if costs[k] == cost else np.uint16(NO_COST)
        found = min(found, here)
    return int(found)


@njit(cache=True, nogil=True)
def right_minima(
    sums: NDArray[np.uint16],
    y: int,
    minimum: int,
    best: NDArray[np.uint16],
    right_winner: NDArray[np.uint16],
) -> None:
    """Choose the best candidate of each pixel of row ``y`` of the right view.

    Args:
        sums: uint16 (W, ndisp), costs of the candidates of the row of the left view.
        y: The row to write to.
        minimum: Disparity of candidate 0, pixels.
        best: uint16 (2, W + ndisp), room for costs and candidates; right column
            ``x - minimum - k`` stands at ``W - 1 - x + k``.
        right_winner: uint16 (H, W), written: row ``y``; ndisp = no left pixel sees it.
    """
    width, ndisp = right_winner.shape[1], sums.shape[1]
    best[0] = np.uint16(NO_COST)
    best[1] = np.uint16(ndisp)
    for x in range(width):
        start = width - 1 - x
        here = sums[x]
        lowest = best[0, start : start + ndisp]
        which = best[1, start : start + ndisp]
        for k in range(ndisp):
            cost, other, index = here[k], lowest[k], which[k]
            better = cost < other
            lowest[k] = cost if better else other
            which[k] = np.uint16(k) if better else index
    for x in range(width):
        place = width - 1 - minimum - x
        inside = 0 <= place < width + ndisp - 1
        right_winner[y, x] = best[1, place] if inside else np.uint16(ndisp)


@njit(cache=True, nogil=True)
def claim_right(ndisp: int, minimum: int, y: int, minima: Minima) -> None:
    """Match each pixel of row ``y`` of the right view to the left pixel that chose it best.

    The left pixel of the least cost gets it, of equal ones the leftmost. Weaker than a search of
    the right view among all costs, but it costs a hundredth of that.

    Args:
        ndisp: Number of candidates.
        minimum: Disparity of candidate 0, pixels.
        y: The row.
        minima: Read: row ``y`` of ``winner`` and the best costs. Written: row ``y`` of
            ``right_winner``.
    """
    best = np.full(minima.winner.shape[1], NO_COST, np.uint16)
    minima.right_winner[y] = ndisp
    for x in range(best.size):
        k = np.int64(minima.winner[y, x])
        cost = minima.costs[0, y, x]
        if k < ndisp and cost < best[x - minimum - k]:
            best[x - minimum - k] = cost
            minima.right_winner[y, x - minimum - k] = k
