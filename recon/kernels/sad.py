"""Sums of absolute differences over a window, and the best candidate of each pixel.

How it is fast: every loop that costs time runs over neighbouring columns, in uint8 and uint16
alone, for one candidate or eight at once, so that a vector instruction does 32 or 64 pixels. A
window is made of two halves (`recon.kernels.half_windows`), each summed up once for two rows.
Blocks of columns are so narrow that all this stays in a core's own cache.

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

from recon.kernels.half_windows import BLOCK, Halves, Room, Search, Views, next_half
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
    for x0 in range(0, views.width, room.block):
        x1 = min(x0 + room.block, views.width)
        for y in range(first - search.rows_radius, end):
            halves = next_half(views, search, first, y, x0, room)
            if y >= first:
                _choose(halves, search, y, x0, x1, room.found, minima)
    for y in range(first, end):
        claim_right(search.ndisp, search.minimum, y, minima)


@njit(cache=True, nogil=True)
def _choose(
    halves: Halves,
    search: Search,
    y: int,
    x0: int,
    x1: int,
    found: NDArray[np.uint16],
    minima: Minima,
) -> None:
    """Choose among the candidates of columns ``x0`` to ``x1 - 1`` of row ``y``."""
    width, ahead, block = minima.winner.shape[1], search.minimum - x0, x1 - x0
    found[:BLOCK] = search.ndisp
    found[BLOCK:] = NO_COST
    # Candidate k exists in columns [k + ahead, k + ahead + width) of the block.
    for k in range(0, search.ndisp, 8):
        start, end = max(k + 7 + ahead, 0), min(k + ahead + width, block)
        if k + 8 > search.ndisp or start >= end:
            start = end = block
        # Calls are dear here, and most blocks lie wholly where all eight exist.
        if start > 0:
            _offer_each(halves, search, k, ahead, width, 0, start, found)
        if start < end:
            _offer_eight(halves, search.lean, k, start, end, found)
        if end < block:
            _offer_each(halves, search, k, ahead, width, end, block, found)
    minima.winner[y, x0:x1] = found[:block]
    minima.costs[0, y, x0:x1] = found[BLOCK : BLOCK + block]
    minima.costs[3, y, x0:x1] = found[2 * BLOCK : 2 * BLOCK + block]
    _look_beside(halves, search, y, x0, x1, minima)


@njit(cache=True, nogil=True)
def _offer_each(
    halves: Halves,
    search: Search,
    first: int,
    ahead: int,
    width: int,
    start: int,
    end: int,
    found: NDArray[np.uint16],
) -> None:
    """Offer the candidates from ``first`` on, at most eight, to the columns where each exists."""
    upper, lower, lean = halves.upper, halves.lower, search.lean
    for k in range(first, min(first + 8, search.ndisp)):
        n, begin = k + abs(lean), k + ahead
        for x in range(max(begin, start), min(begin + width, end)):
            cost = _lower(upper[n, x], lower[n, x], upper[n - lean, x], lower[n + lean, x])
            best, second, prior = x + BLOCK, x + 2 * BLOCK, x + 3 * BLOCK
            found[x], found[best], found[second], found[prior] = _weigh(
                cost, np.uint16(k), found[x], found[best], found[second], found[prior]
            )


@njit(cache=True, nogil=True)
def _offer_eight(
    halves: Halves, lean: int, k: int, start: int, end: int, found: NDArray[np.uint16]
) -> None:
    """As `_offer_each` where all of eight candidates exist, with what was found in registers."""
    upper, lower, n = halves.upper, halves.lower, k + abs(lean)
    u0, u1, u2, u3 = upper[n], upper[n + 1], upper[n + 2], upper[n + 3]
    u4, u5, u6, u7 = upper[n + 4], upper[n + 5], upper[n + 6], upper[n + 7]
    l0, l1, l2, l3 = lower[n], lower[n + 1], lower[n + 2], lower[n + 3]
    l4, l5, l6, l7 = lower[n + 4], lower[n + 5], lower[n + 6], lower[n + 7]
    n -= lean
    v0, v1, v2, v3 = upper[n], upper[n + 1], upper[n + 2], upper[n + 3]
    v4, v5, v6, v7 = upper[n + 4], upper[n + 5], upper[n + 6], upper[n + 7]
    n += 2 * lean
    m0, m1, m2, m3 = lower[n], lower[n + 1], lower[n + 2], lower[n + 3]
    m4, m5, m6, m7 = lower[n + 4], lower[n + 5], lower[n + 6], lower[n + 7]
    k0, k1, k2, k3 = np.uint16(k), np.uint16(k + 1), np.uint16(k + 2), np.uint16(k + 3)
    k4, k5, k6, k7 = np.uint16(k + 4), np.uint16(k + 5), np.uint16(k + 6), np.uint16(k + 7)
    best, second, prior = np.uint64(BLOCK), np.uint64(2 * BLOCK), np.uint64(3 * BLOCK)
    # Unsigned: an index that cannot be negative needs no check, which would cost the vectors.
    for x in range(np.uint64(start), np.uint64(end)):
        c0 = _lower(u0[x], l0[x], v0[x], m0[x])
        c1 = _lower(u1[x], l1[x], v1[x], m1[x])
        c2 = _lower(u2[x], l2[x], v2[x], m2[x])
        c3 = _lower(u3[x], l3[x], v3[x], m3[x])
        c4 = _lower(u4[x], l4[x], v4[x], m4[x])
        c5 = _lower(u5[x], l5[x], v5[x], m5[x])
        c6 = _lower(u6[x], l6[x], v6[x], m6[x])
        c7 = _lower(u7[x], l7[x], v7[x], m7[x])
        w, b, s, p = found[x], found[x + best], found[x + second], found[x + prior]
        w, b, s, p = _weigh(c0, k0, w, b, s, p)
        w, b, s, p = _weigh(c1, k1, w, b, s, p)
        w, b, s, p = _weigh(c2, k2, w, b, s, p)
        w, b, s, p = _weigh(c3, k3, w, b, s, p)
        w, b, s, p = _weigh(c4, k4, w, b, s, p)
        w, b, s, p = _weigh(c5, k5, w, b, s, p)
        w, b, s, p = _weigh(c6, k6, w, b, s, p)
        w, b, s, p = _weigh(c7, k7, w, b, s, p)
        found[x], found[x + best], found[x + second], found[x + prior] = w, b, s, p


@njit(cache=True, nogil=True)
def _lower(
    upper: np.uint16, lower: np.uint16, leaning_upper: np.uint16, leaning_lower: np.uint16
) -> np.uint16:
    """The cost of the better of the two windows."""
    return min(np.uint16(upper + lower), np.uint16(leaning_upper + leaning_lower))


@njit(cache=True, nogil=True)
def _weigh(
    cost: np.uint16,
    k: np.uint16,
    winner: np.uint16,
    best: np.uint16,
    second: np.uint16,
    prior: np.uint16,
) -> tuple[np.uint16, np.uint16, np.uint16, np.uint16]:
    """What is found of a pixel (winner, best, second, prior) once candidate ``k`` is offered."""
    # Choices, not branches, and nothing computed in them: so they become vector instructions.
    least = min(second, cost)
    least = second if winner == np.uint16(k - np.uint16(1)) else least
    second = prior if cost < best else least
    winner = k if cost < best else winner
    return winner, min(best, cost), second, best


@njit(cache=True, nogil=True)
def _look_beside(halves: Halves, search: Search, y: int, x0: int, x1: int, minima: Minima) -> None:
    """Write the costs before and after each best, from the window that won: a fit mixes no two."""
    upper, lower = halves.upper.reshape(-1), halves.lower.reshape(-1)
    width, stride = minima.winner.shape[1], halves.upper.shape[1]
    lean = search.lean * stride
    for x in range(x0, x1):
        before, after = np.uint16(NO_COST), np.uint16(NO_COST)
        k = np.int64(minima.winner[y, x])
        if k < search.ndisp:
            at = (k + abs(search.lean)) * stride + x - x0
            own = lean if _of(upper, lower, at, lean) < _of(upper, lower, at, 0) else 0
            right = x - search.minimum - k
            if k > 0 and right + 1 < width:
                before = _of(upper, lower, at - stride, own)
            if k + 1 < search.ndisp and right > 0:
                after = _of(upper, lower, at + stride, own)
        minima.costs[1, y, x], minima.costs[2, y, x] = before, after


@njit(cache=True, nogil=True)
def _of(upper: NDArray[np.uint16], lower: NDArray[np.uint16], at: int, lean: int) -> np.uint16:
    """The cost of the window whose halves lean by so many places; unsigned needs no checks."""
    cost: np.uint16 = np.uint16(upper[np.uint64(at - lean)] + lower[np.uint64(at + lean)])
    return cost
