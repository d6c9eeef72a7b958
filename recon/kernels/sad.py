"""Sums of absolute differences over a window, and the best candidate of each pixel.

How it is fast: every loop that costs time runs over neighbouring columns, in uint8 and uint16
alone, for one candidate or eight at once, so that a vector instruction does 32 or 64 pixels. A
window is made of an upper and a lower half that share the middle row. The lower half of a row is
the upper half of a row further down: it is summed up once and kept in a ring of rows. Its sums over
one column move down by one row in and one row out; those over its columns are put together from
sums of two and of four. Blocks of columns are so narrow that all this stays in a core's own cache.

Two halves that are moved against each other make a window that leans: beside the upright window
it costs one more addition, not one more search.

The twin in plain numpy, `recon.kernels.sad_reference.sad_minima_reference`, says what the
results are.

Ref: K. Mühlmann et al., "Calculating dense disparity maps from color stereo images, an efficient
implementation", IJCV 47, 2002; N. Einecke, J. Eggert, "A multi-block-matching approach for
stereo", IEEE Intelligent Vehicles, 2015 (several windows).
"""

from __future__ import annotations

from typing import Any, Final, NamedTuple

import numpy as np
from numba import njit
from numpy.typing import NDArray

from recon.kernels.minima import NO_COST, Minima, claim_right

_CACHE_BYTES: Final = 1024 * 1024
"""What the ring of half windows may take of a core's own cache (1 MB on most machines of today)."""

_CHUNK: Final = 16
"""Candidates whose columns are put together at a time: their sums stay in the first cache."""

_BLOCK: Final = 1024
"""Most columns of a block."""


class Search(NamedTuple):
    """What is searched, and over which windows.

    Attributes:
        ndisp: Number of candidates.
        minimum: Disparity of candidate 0, pixels.
        radius: Half width of the window, pixels: it is ``2·radius + 1`` wide.
        rows_radius: Half height of the window, pixels.
        cost_cap: Largest cost of one pixel; times the pixels of both halves it is < 65535.
        lean: By how many candidates the lower half of the leaning window is moved up and its upper
            half down; 0 = there is no such window.
    """

    ndisp: int
    minimum: int
    radius: int
    rows_radius: int
    cost_cap: int
    lean: int


class Views(NamedTuple):
    """Both pictures, continued by their border pixels.

    Attributes:
        left: uint8 (H, C); column ``c`` is column ``c - radius`` of the picture.
        right: uint8 (H, C + n - 1), n = ndisp + 2·abs(lean); column ``c`` sees candidate
            ``k`` at column ``c + n - 1 - abs(lean) - k``.
        width: Columns of the picture.
    """

    left: NDArray[np.uint8]
    right: NDArray[np.uint8]
    width: int


class Room(NamedTuple):
    """Memory to work in; what the kernel finds there does not matter.

    Attributes:
        columns: uint8 or uint16 (n, S), sums over one column of a half, per candidate.
        pairs: uint8 or uint16 (CHUNK·S,), sums over two columns.
        fours: uint16 (CHUNK·S,), sums over four columns.
        no_pairs: As ``pairs``, noughts.
        no_fours: As ``fours``, noughts.
        halves: uint16 (rows_radius + 1, n, S), a ring of rows: sums over a half.
        found: uint16 (4·_BLOCK,), of each column of a row: the best of the candidates offered so
            far (ndisp = none), its cost, the least cost of those two or more away from it, and
            the least cost of all but the last one offered. One array, because the compiler checks
            every one that is written for overlaps.
        block: Columns done at a time, at most S - 2·radius.
    """

    columns: NDArray[Any]
    pairs: NDArray[Any]
    fours: NDArray[np.uint16]
    no_pairs: NDArray[Any]
    no_fours: NDArray[np.uint16]
    halves: NDArray[np.uint16]
    found: NDArray[np.uint16]
    block: int


class Halves(NamedTuple):
    """Both halves of the windows of a row, summed up.

    Attributes:
        upper: uint16 (n, S), the rows above a pixel and its own.
        lower: uint16 (n, S), its own and those below.
    """

    upper: NDArray[np.uint16]
    lower: NDArray[np.uint16]


def lay_out(left: NDArray[np.uint8], right: NDArray[np.uint8], search: Search) -> Views:
    """Both pictures as the search reads them.

    Args:
        left: uint8 (H, W).
        right: uint8 (H, W).
        search: What will be searched.
    """
    width, lean = left.shape[1], abs(search.lean)
    last = search.ndisp + 2 * lean - 1
    columns = np.arange(width + _stride(search, width)) - search.radius
    shifted = np.arange(len(columns) + last) - search.radius - search.minimum + lean - last
    return Views(
        np.take(left, columns, axis=1, mode="clip"),
        np.take(right, shifted, axis=1, mode="clip"),
        width,
    )


def make_room(search: Search, width: int) -> Room:
    """Memory for one thread's search in pictures of a width."""
    candidates, stride = search.ndisp + 2 * abs(search.lean), _stride(search, width)
    rows = search.rows_radius + 1
    narrow = [np.uint8 if n * rows * search.cost_cap <= 255 else np.uint16 for n in (1, 2)]
    return Room(
        columns=np.empty((candidates, stride), narrow[0]),
        pairs=np.zeros(_CHUNK * stride, narrow[1]),
        fours=np.zeros(_CHUNK * stride, np.uint16),
        no_pairs=np.zeros(_CHUNK * stride, narrow[1]),
        no_fours=np.zeros(_CHUNK * stride, np.uint16),
        halves=np.empty((rows, candidates, stride), np.uint16),
        found=np.empty(4 * _BLOCK, np.uint16),
        block=stride - 2 * search.radius,
    )


def _stride(search: Search, width: int) -> int:
    """Columns of a block with those that its windows reach over, a multiple of 32."""
    rows = search.rows_radius + 1
    bytes_per_column = 2 * rows * (search.ndisp + 2 * abs(search.lean))
    widest = max(_CACHE_BYTES // bytes_per_column, 64 + 2 * search.radius)
    blocks = -(-width // min(widest - 2 * search.radius, _BLOCK))
    return -(-(-(-width // blocks) + 2 * search.radius) // 32) * 32


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
            halves = _next_half(views, search, first, y, x0, room)
            if y >= first:
                _choose(halves, search, y, x0, x1, room.found, minima)
    for y in range(first, end):
        claim_right(search.ndisp, search.minimum, y, minima)


@njit(cache=True, nogil=True)
def _next_half(views: Views, search: Search, first: int, y: int, x0: int, room: Room) -> Halves:
    """Sum up the half window below row ``y``; give the halves above and below it."""
    rows, start = search.rows_radius + 1, first - search.rows_radius
    last = views.left.shape[0] - 1
    if y == start:
        room.columns[:] = 0
        for row in range(y, y + rows):
            _add_row(views, search, min(max(row, 0), last), x0, room.columns)
    else:
        come, gone = min(max(y + rows - 1, 0), last), min(max(y - 1, 0), last)
        _exchange_row(views, search, come, gone, x0, room.columns)
    lower = room.halves[(y - start) % rows]
    _sum_columns(room, search.radius, lower)
    # The half above row y is that below row y - rows_radius, the oldest of the ring.
    return Halves(room.halves[(y - start + 1) % rows], lower)


@njit(cache=True, nogil=True)
def _add_row(views: Views, search: Search, y: int, x0: int, columns: NDArray[Any]) -> None:
    """Add the costs of the pixels of row ``y`` to the column sums."""
    cap = np.uint8(search.cost_cap)
    candidates, stride = columns.shape
    left = views.left[y, x0 : x0 + stride]
    for n in range(candidates):
        right = views.right[y, x0 + candidates - 1 - n :]
        sums = columns[n]
        for c in range(stride):
            sums[c] += _difference(left[c], right[c], cap)


@njit(cache=True, nogil=True)
def _exchange_row(
    views: Views, search: Search, come: int, gone: int, x0: int, columns: NDArray[Any]
) -> None:
    """Take the costs of row ``gone`` out of the column sums and add those of row ``come``."""
    cap = np.uint8(search.cost_cap)
    candidates, stride = columns.shape
    left, left_gone = views.left[come, x0 : x0 + stride], views.left[gone, x0 : x0 + stride]
    for n in range(candidates):
        start = x0 + candidates - 1 - n
        right, right_gone = views.right[come, start:], views.right[gone, start:]
        sums = columns[n]
        for c in range(stride):
            plus = _difference(left[c], right[c], cap)
            minus = _difference(left_gone[c], right_gone[c], cap)
            sums[c] = sums[c] - minus + plus


@njit(cache=True, nogil=True)
def _difference(a: np.uint8, b: np.uint8, cap: np.uint8) -> np.uint8:
    """``min(|a - b|, cap)`` without leaving uint8."""
    return min(np.uint8(max(a, b) - min(a, b)), cap)


@njit(cache=True, nogil=True)
def _sum_columns(room: Room, radius: int, sums: NDArray[np.uint16]) -> None:
    """Write the sums over ``2·radius + 1`` columns to ``sums``, (n, S).

    Candidates lie one behind the other: the last ``2·radius`` sums of each run into the next, and
    nobody reads them.
    """
    candidates, stride = sums.shape
    columns, flat = room.columns.reshape(-1), sums.reshape(-1)
    for n in range(0, candidates, _CHUNK):
        start, end = n * stride, min(n + _CHUNK, candidates) * stride
        _sum_window(columns[start:end], 2 * radius + 1, room, flat[start:end])


@njit(cache=True, nogil=True)
def _sum_window(values: NDArray[Any], window: int, room: Room, sums: NDArray[np.uint16]) -> None:
    """Write the sums over ``window`` neighbours, an odd number, of all but the last values."""
    pairs, fours = room.pairs, room.fours
    beside, beyond = values[1:], pairs[2:]
    for i in range(values.size - 1):
        pairs[i] = values[i] + beside[i]
    for i in range(values.size - 3):
        fours[i] = np.uint16(pairs[i]) + np.uint16(beyond[i])
    # One pass for up to two fours and the rest, 1 or 3; a term that is not there is noughts.
    whole = window // 4
    one = values[window - 1 :]
    two = pairs[window - 3 :] if window % 4 == 3 else room.no_pairs
    four = fours if whole > 0 else room.no_fours
    other = fours[4:] if whole > 0 and whole % 2 == 0 else room.no_fours
    count = values.size - window + 1
    for i in range(count):
        most = np.uint16(np.uint16(four[i] + other[i]) + np.uint16(two[i]))
        sums[i] = np.uint16(most + np.uint16(one[i]))
    for n in range(2 - whole % 2, whole, 2):
        four, other = fours[4 * n :], fours[4 * n + 4 :]
        for i in range(count):
            sums[i] = np.uint16(sums[i] + np.uint16(four[i] + other[i]))


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
    found[:_BLOCK] = search.ndisp
    found[_BLOCK:] = NO_COST
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
    minima.costs[0, y, x0:x1] = found[_BLOCK : _BLOCK + block]
    minima.costs[3, y, x0:x1] = found[2 * _BLOCK : 2 * _BLOCK + block]
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
            best, second, prior = x + _BLOCK, x + 2 * _BLOCK, x + 3 * _BLOCK
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
    best, second, prior = np.uint64(_BLOCK), np.uint64(2 * _BLOCK), np.uint64(3 * _BLOCK)
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
    width, stride = minima.winner.shape[1], np.uint64(halves.upper.shape[1])
    # Unsigned steps through flat arrays need no checks; a lean below nought wraps round twice.
    lean = np.uint64(search.lean) * stride
    for x in range(x0, x1):
        before, after = np.uint16(NO_COST), np.uint16(NO_COST)
        k = np.int64(minima.winner[y, x])
        if k < search.ndisp:
            at = np.uint64(k + abs(search.lean)) * stride + np.uint64(x - x0)
            leaning = np.uint16(upper[at - lean] + lower[at + lean])
            own = lean if leaning < np.uint16(upper[at] + lower[at]) else np.uint64(0)
            right = x - search.minimum - k
            if k > 0 and right + 1 < width:
                before = np.uint16(upper[at - stride - own] + lower[at - stride + own])
            if k + 1 < search.ndisp and right > 0:
                after = np.uint16(upper[at + stride - own] + lower[at + stride + own])
        minima.costs[1, y, x], minima.costs[2, y, x] = before, after
