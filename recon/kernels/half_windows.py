"""Sums of absolute differences over half windows, one row after the other.

A window is made of an upper and a lower half that share the middle row. The lower half of a row is
the upper half of a row further down: it is summed up once and kept in a ring of rows. Its sums over
one column move down by one row in and one row out; those over its columns are put together from
sums of two and of four.
"""

from __future__ import annotations

from typing import Any, Final, NamedTuple

import numpy as np
from numba import njit
from numpy.typing import NDArray

_CACHE_BYTES: Final = 1024 * 1024
"""What the ring of half windows may take of a core's own cache (1 MB on most machines of today)."""

_CHUNK: Final = 16
"""Candidates whose columns are put together at a time: their sums stay in the first cache."""

BLOCK: Final = 1024
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
        found: uint16 (4·BLOCK,), of each column of a row: the best of the candidates offered so
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
        found=np.empty(4 * BLOCK, np.uint16),
        block=stride - 2 * search.radius,
    )


def _stride(search: Search, width: int) -> int:
    """Columns of a block with those that its windows reach over, a multiple of 32."""
    rows = search.rows_radius + 1
    bytes_per_column = 2 * rows * (search.ndisp + 2 * abs(search.lean))
    widest = max(_CACHE_BYTES // bytes_per_column, 64 + 2 * search.radius)
    blocks = -(-width // min(widest - 2 * search.radius, BLOCK))
    return -(-(-(-width // blocks) + 2 * search.radius) // 32) * 32


@njit(cache=True, nogil=True)
def next_half(views: Views, search: Search, first: int, y: int, x0: int, room: Room) -> Halves:
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
        pairs[i] = np.uint16(values[i]) + np.uint16(beside[i])
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
