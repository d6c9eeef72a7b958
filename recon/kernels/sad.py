"""Sums of absolute differences over a window, and their minima in both views.

The loops that cost time run over contiguous disparities, in uint8 and uint16 alone: the right
image is mirrored, so that a growing disparity is a growing index, and every intermediate is
cast back, because one int64 in a loop costs its vector instructions. A window sum is never
computed anew: the sums over one column of the window move down by one row in and one row out,
and the window moves right by one column in and one out.

The twin in plain numpy, `recon.kernels.sad_reference.sad_minima_reference`, says what the
results are.

Ref: K. Mühlmann et al., "Calculating dense disparity maps from color stereo images, an efficient
implementation", IJCV 47, 2002; N. Einecke, J. Eggert, "A multi-block-matching approach for
stereo", IEEE Intelligent Vehicles, 2015 (several windows).
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from numba import njit
from numpy.typing import NDArray

from recon.kernels.minima import NO_COST, Minima, left_minima, right_minima


class Search(NamedTuple):
    """What is searched, and over which windows.

    Attributes:
        ndisp: Number of candidates.
        minimum: Disparity of candidate 0, pixels.
        radius: Half width of the window, pixels: it is ``2·radius + 1`` wide.
        rows_radius: Half height of the window, pixels.
        cost_cap: Largest cost of one pixel; times the pixels of the window it is < 65535.
        slant: Disparity per row of a second, slanted window, pixels; 0 = there is none.
    """

    ndisp: int
    minimum: int
    radius: int
    rows_radius: int
    cost_cap: int
    slant: float


def mirror_right(right: NDArray[np.uint8], search: Search) -> NDArray[np.uint8]:
    """The right picture from right to left, its border columns repeated as the search needs.

    Args:
        right: uint8 (H, W).
        search: What will be searched.

    Returns:
        uint8 (H, W + 2·margin + ndisp - 1), where ``margin`` is the radius and what the slant
        reaches over; column ``j`` is right column ``W - 1 + margin - minimum - j``, clamped to
        the picture.
    """
    width, margin = right.shape[1], search.radius + slant_reach(search)
    places = np.arange(width + 2 * margin + search.ndisp - 1)
    columns = np.clip(width - 1 + margin - search.minimum - places, 0, width - 1)
    return np.ascontiguousarray(right[:, columns])


@njit(cache=True, nogil=True)
def slant_offset(search: Search, dy: int) -> int:
    """By how many candidates the slanted window leans ``dy`` rows below its middle."""
    return int(np.floor(dy * search.slant + 0.5))


@njit(cache=True, nogil=True)
def slant_reach(search: Search) -> int:
    """Largest absolute `slant_offset` of the window."""
    rows = search.rows_radius
    reach: int = max(abs(slant_offset(search, rows)), abs(slant_offset(search, -rows)))
    return reach


@njit(cache=True, nogil=True)
def sad_minima(
    left: NDArray[np.uint8],
    mirrored: NDArray[np.uint8],
    search: Search,
    first: int,
    end: int,
    minima: Minima,
) -> None:
    """Find the best candidate of each pixel of some rows, in the left and the right view.

    Candidate ``k`` of a pixel is the disparity ``minimum + k``. Its cost is the sum over the
    window of ``min(|left - right|, cost_cap)``, both pictures continued by their border pixels;
    with a slant it is the smaller of that and of the same sum where the disparity grows by
    ``slant`` per row (rounded), as on the ground under a camera. Candidates whose right pixel
    lies outside the picture do not exist. Of equal costs the smaller disparity wins. The costs
    before and after the best are those of the window that won, the upright one if both did.

    Args:
        left: uint8 (H, W), the left picture.
        mirrored: The right picture, from `mirror_right`.
        search: What is searched.
        first: First row to do.
        end: The row after the last. The rows of a call depend on no other call.
        minima: Written: the rows ``first`` to ``end - 1``.
    """
    width, ndisp = left.shape[1], search.ndisp
    columns = np.zeros((width + 2 * search.radius, ndisp), np.uint16)
    slanted_columns = np.empty(columns.shape if search.slant else (0, 0), np.uint16)
    upright = np.empty((width, ndisp), np.uint16)
    slanted, lowest = np.empty_like(upright), np.empty_like(upright)
    right_best = np.empty((2, width + ndisp), np.uint16)
    for y in range(first, end):
        _move_down(left, mirrored, search, first, y, columns)
        _sum_windows(columns, search.radius, upright)
        if search.slant:
            _sum_slanted_columns(left, mirrored, search, y, slanted_columns)
            _sum_windows(slanted_columns, search.radius, slanted)
            _lower(upright.reshape(-1), slanted.reshape(-1), lowest.reshape(-1))
        costs = lowest if search.slant else upright
        left_minima(costs, y, search.minimum, minima)
        right_minima(costs, y, search.minimum, right_best, minima.right_winner)
        if search.slant:
            _neighbours_of_the_same_window(upright, slanted, y, minima)


@njit(cache=True, nogil=True)
def _move_down(
    left: NDArray[np.uint8],
    mirrored: NDArray[np.uint8],
    search: Search,
    start: int,
    y: int,
    columns: NDArray[np.uint16],
) -> None:
    """Make ``columns`` the sums around row ``y``, from those around the row above."""
    reach, last = search.rows_radius, left.shape[0] - 1
    if y > start:
        come, gone = min(y + reach, last), max(y - reach - 1, 0)
        _exchange_row(left, mirrored, search, come, gone, columns)
        return
    for dy in range(-reach, reach + 1):
        _add_row(left, mirrored, search, min(max(y + dy, 0), last), 0, columns)


@njit(cache=True, nogil=True)
def _add_row(
    left: NDArray[np.uint8],
    mirrored: NDArray[np.uint8],
    search: Search,
    y: int,
    offset: int,
    columns: NDArray[np.uint16],
) -> None:
    """Add the costs of the pixels of row ``y``, ``offset`` candidates aside, to the column sums."""
    cap = np.uint8(search.cost_cap)
    last, reach = left.shape[1] - 1, slant_reach(search)
    for c in range(columns.shape[0]):
        a = left[y, min(max(c - search.radius, 0), last)]
        start = last + 2 * search.radius + reach + offset - c
        sums = columns[c]
        right = mirrored[y, start : start + sums.size]
        for k in range(sums.size):
            sums[k] = np.uint16(sums[k] + np.uint16(_difference(a, right[k], cap)))


@njit(cache=True, nogil=True)
def _exchange_row(
    left: NDArray[np.uint8],
    mirrored: NDArray[np.uint8],
    search: Search,
    come: int,
    gone: int,
    columns: NDArray[np.uint16],
) -> None:
    """Take the costs of row ``gone`` out of the column sums and add those of row ``come``."""
    cap = np.uint8(search.cost_cap)
    last, reach = left.shape[1] - 1, slant_reach(search)
    for c in range(columns.shape[0]):
        x = min(max(c - search.radius, 0), last)
        a, a_gone = left[come, x], left[gone, x]
        sums = columns[c]
        start = last + 2 * search.radius + reach - c
        right = mirrored[come, start : start + sums.size]
        right_gone = mirrored[gone, start : start + sums.size]
        for k in range(sums.size):
            plus = np.uint16(_difference(a, right[k], cap))
            minus = np.uint16(_difference(a_gone, right_gone[k], cap))
            sums[k] = np.uint16(np.uint16(sums[k] - minus) + plus)


@njit(cache=True, nogil=True)
def _sum_slanted_columns(
    left: NDArray[np.uint8],
    mirrored: NDArray[np.uint8],
    search: Search,
    y: int,
    columns: NDArray[np.uint16],
) -> None:
    """Write the column sums of the slanted windows around row ``y``; they cannot be moved down."""
    columns[:] = np.uint16(0)
    for dy in range(-search.rows_radius, search.rows_radius + 1):
        row = min(max(y + dy, 0), left.shape[0] - 1)
        _add_row(left, mirrored, search, row, slant_offset(search, dy), columns)


@njit(cache=True, nogil=True)
def _difference(a: np.uint8, b: np.uint8, cap: np.uint8) -> np.uint8:
    """``min(|a - b|, cap)`` without leaving uint8."""
    return min(np.uint8(max(a, b) - min(a, b)), cap)


@njit(cache=True, nogil=True)
def _sum_windows(columns: NDArray[np.uint16], radius: int, sums: NDArray[np.uint16]) -> None:
    """Write the window sums of a row to ``sums``."""
    sums[0] = np.uint16(0)
    for c in range(2 * radius + 1):
        for k in range(sums.shape[1]):
            sums[0, k] = np.uint16(sums[0, k] + columns[c, k])
    for x in range(1, sums.shape[0]):
        gone, come = x - 1, x + 2 * radius
        for k in range(sums.shape[1]):
            rest = np.uint16(sums[x - 1, k] - columns[gone, k])
            sums[x, k] = np.uint16(rest + columns[come, k])


@njit(cache=True, nogil=True)
def _lower(
    costs: NDArray[np.uint16], others: NDArray[np.uint16], lowest: NDArray[np.uint16]
) -> None:
    """Write the lower of two costs, for all candidates."""
    for k in range(lowest.size):
        lowest[k] = min(costs[k], others[k])


@njit(cache=True, nogil=True)
def _neighbours_of_the_same_window(
    upright: NDArray[np.uint16], slanted: NDArray[np.uint16], y: int, minima: Minima
) -> None:
    """Take the costs before and after the best from the window that won: a fit mixes no two."""
    for x in range(upright.shape[0]):
        k = np.int64(minima.winner[y, x])
        if k == upright.shape[1]:
            continue
        own = upright[x] if upright[x, k] <= slanted[x, k] else slanted[x]
        if minima.costs[1, y, x] != NO_COST:
            minima.costs[1, y, x] = own[k - 1]
        if minima.costs[2, y, x] != NO_COST:
            minima.costs[2, y, x] = own[k + 1]
