"""Sums of absolute differences over half windows, one row after the other.

A window is made of an upper and a lower half that share the middle row. The lower half of a row is
the upper half of a row further down: it is summed up once and kept in a ring of rows. Its sums over
one column move down by one row in and one row out; the half moves to the right by one column in and
one column out.

The candidates of a pixel lie side by side, in places 0 to N - 1, a multiple of `LANES`: place ``n``
is candidate ``n - abs(lean)``, so that a leaning half finds candidates before the first and after
the last. Both moves so are a few vector instructions for `LANES` candidates, with the half of the
pixel before still in its register.
"""

from __future__ import annotations

from typing import Any, Final, NamedTuple

import numpy as np
from numba import njit
from numpy.typing import NDArray

from recon.kernels.lanes import (
    LANES,
    Lanes,
    distance,
    fit,
    least,
    load,
    splat,
    spread,
    store,
    widen_signed,
)
from recon.kernels.minima import NO_COST
from recon.kernels.path_costs import aligned

_CACHE_BYTES: Final = 512 * 1024
"""What the ring of half windows may take of a core's own cache (1 MB on most machines of today)."""

_FOURFOLD: Final = np.uint32(0x01010101)
"""A byte times this is that byte four times."""

RUN: Final = 48
"""Columns of a row whose halves are summed up, and chosen from, before the next: they stay in the
first cache."""


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
        left: uint32 (H, C), each grey level as four equal bytes (see `spread`); column ``c`` is
            column ``c - radius - 1`` of the picture.
        right: uint8 (H, C - 1 + N), mirrored, so that candidates lie side by side; place ``n`` of
            left column ``c`` is column ``C - 1 - c + n``.
        width: Columns of the picture.
    """

    left: NDArray[np.uint32]
    right: NDArray[np.uint8]
    width: int


class Row(NamedTuple):
    """One row of `Views`."""

    left: NDArray[np.uint32]
    right: NDArray[np.uint8]


class Room(NamedTuple):
    """Memory to work in; what the kernel finds there does not matter.

    Attributes:
        columns: uint8 or uint16 ((block + 2·radius + 1)·N,), of each column: sums over one column
            of a half.
        carried: uint16 (N,), the half windows of the last column done.
        halves: uint16 (rows_radius + 1, at least block·N), a ring of rows; of each column: sums
            over a half.
        none: uint16 (LANES,), `NO_COST`. From memory, because compilers make a register of ones
            out of the register itself: then no pixel starts before the last one is done.
        places: Places of a column, N.
        block: Columns done at a time.
    """

    columns: NDArray[Any]
    carried: NDArray[np.uint16]
    halves: NDArray[np.uint16]
    none: NDArray[np.uint16]
    places: int
    block: int


class Halves(NamedTuple):
    """Both halves of the windows of a row, summed up: uint16, N of each column of a block.

    Attributes:
        upper: The rows above a pixel and its own.
        lower: Its own and those below.
        places: Places of a column, N.
    """

    upper: NDArray[np.uint16]
    lower: NDArray[np.uint16]
    places: int


def empty_views(search: Search, height: int, width: int) -> Views:
    """Arrays for `lay_out` to write to."""
    columns = width + 2 * search.radius + 1
    right = np.empty((height, columns - 1 + _places(search)), np.uint8)
    return Views(np.empty((height, columns), np.uint32), right, width)


@njit(cache=True, nogil=True)
def lay_out(
    left: NDArray[np.uint8],
    right: NDArray[np.uint8],
    search: Search,
    first: int,
    end: int,
    views: Views,
) -> None:
    """Lay out some rows of both pictures as the search reads them.

    Args:
        left: uint8 (H, W).
        right: uint8 (H, W).
        search: What will be searched.
        first: First row to do.
        end: The row after the last.
        views: Written: the rows.
    """
    width, left_at = views.width, search.radius + 1
    # Mirrored, the picture's last column comes first.
    right_at = views.left.shape[1] - width - left_at - search.minimum + abs(search.lean)
    mirrored = np.empty(width, np.uint8)
    for y in range(first, end):
        for x in range(width):
            mirrored[x] = right[y, np.uint64(width - 1 - x)]
        _continue(left[y], left_at, _FOURFOLD, views.left[y])
        _continue(mirrored, right_at, np.uint8(1), views.right[y])


@njit(cache=True, nogil=True)
def _continue(pixels: NDArray[np.uint8], at: int, factor: Any, view: NDArray[Any]) -> None:
    """Write a row of pixels to ``at`` and on, continued by its ends, all times a factor."""
    start = min(max(at, 0), view.size)
    end = min(max(at + pixels.size, start), view.size)
    view[:start] = pixels[0] * factor
    view[end:] = pixels[-1] * factor
    shown, inside = pixels[start - at :], view[start:end]
    for c in range(inside.size):
        inside[c] = shown[c] * factor


def make_room(search: Search, width: int) -> Room:
    """Memory for one thread's search in pictures of a width."""
    places, rows = _places(search), search.rows_radius + 1
    widest = max(_CACHE_BYTES // (2 * rows * places), RUN)
    block = -(-width // -(-width // widest))
    # The difference of two sums over a column is to fit into a signed byte.
    narrow = np.uint8 if rows * search.cost_cap <= 127 else np.uint16
    # The last vector of the last column may reach over its end.
    return Room(
        columns=aligned(((block + 2 * search.radius + 1) * places,), narrow),
        carried=aligned((places,), np.uint16),
        halves=aligned((rows, (block + 1) * places), np.uint16),
        none=np.full(LANES, NO_COST, np.uint16),
        places=places,
        block=block,
    )


def _places(search: Search) -> int:
    return -(-(search.ndisp + 2 * abs(search.lean)) // LANES) * LANES


@njit(cache=True, nogil=True)
def existing(search: Search, width: int, x: int) -> tuple[int, int]:
    """The first candidate whose right pixel lies in the picture, and the one after the last."""
    right = x - search.minimum
    end = max(min(right + 1, search.ndisp), 0)
    return min(max(right + 1 - width, 0), end), end


@njit(cache=True, nogil=True)
def fill_columns(views: Views, search: Search, y: int, x0: int, room: Room) -> None:
    """Sum up the columns of a block, as `sum_halves` wants them before row ``y``."""
    columns, width = room.columns, min(room.block, views.width - x0)
    cap, columns[:] = splat(np.uint8(search.cost_cap)), 0
    for row in range(y - 1, y + search.rows_radius):
        pixels = _row(views, row)
        for c in range(width + 2 * search.radius + 1):
            for n in range(0, room.places, LANES):
                at = c * room.places + n
                plus = _costs(pixels, x0 + c, n, cap)
                store(columns, at, load(columns, at) + fit(plus, columns))


@njit(cache=True, nogil=True)
def sum_halves(
    views: Views,
    search: Search,
    y: int,
    x0: int,
    start: int,
    end: int,
    room: Room,
    halves: NDArray[np.uint16],
) -> None:
    """Sum up the lower halves of the windows of a row, for a run of the columns of a block.

    Args:
        views: The pictures.
        search: What is searched.
        y: The row, the one after that of the call before.
        x0: First column of the block.
        start: First column of the run, counted from that of the block.
        end: The column after the last.
        room: Its columns and what it carried are read and written.
        halves: Written.
    """
    reach, window, places = 2 * abs(search.lean), 2 * search.radius + 1, room.places
    columns, cap = room.columns, splat(np.uint8(search.cost_cap))
    come, gone = _row(views, y + search.rows_radius), _row(views, y - 1)
    # Places from `begun` on had no candidate that exists so far.
    begun = existing(search, views.width, x0 + start - 1)[1] + reach if start > 0 else 0
    lowest = existing(search, views.width, x0 + start)[0] // LANES * LANES
    highest = existing(search, views.width, x0 + end - 1)[1] + reach
    for n in range(lowest, highest, LANES):
        half = load(room.carried, n)
        if n >= begun:
            half = splat(np.uint16(0))
            for c in range(start, start + window):
                half = half + fit(_exchange(come, gone, x0, c, n, places, cap, columns), halves)
        for c in range(start, end):
            entered = _exchange(come, gone, x0, c + window, n, places, cap, columns)
            half = half + widen_signed(entered - load(columns, c * places + n))
            store(halves, c * places + n, half)
        store(room.carried, n, half)


@njit(cache=True, nogil=True)
def _exchange(
    come: Row,
    gone: Row,
    x0: int,
    c: int,
    n: int,
    places: int,
    cap: Lanes,
    columns: NDArray[Any],
) -> Lanes:
    """Move the sums over a column down by one row, in places ``n`` and on; give them."""
    at = c * places + n
    minus, plus = _costs(gone, x0 + c, n, cap), _costs(come, x0 + c, n, cap)
    sums = load(columns, at) - fit(minus, columns) + fit(plus, columns)
    store(columns, at, sums)
    return sums


@njit(cache=True, nogil=True)
def _costs(row: Row, c: int, n: int, cap: Lanes) -> Lanes:
    """The costs of pixel ``c`` of a row in places ``n`` and on."""
    right = load(row.right, row.left.size - 1 - c + n)
    return least(distance(spread(row.left, c), right), cap)


@njit(cache=True, nogil=True)
def _row(views: Views, y: int) -> Row:
    """A row of both pictures, which go on above and below."""
    row = min(max(y, 0), views.left.shape[0] - 1)
    return Row(views.left[row], views.right[row])
