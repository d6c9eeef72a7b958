"""Sums of absolute differences over half windows, row by row.

A window consists of an upper and a lower half that share the middle row. The lower half of a row is
the upper half of a row further down, so it is summed once and kept in a ring of rows. Column sums
are updated from row to row; sums over the width are put together from sums of two and of four.

Sums are stored place by place, with the columns of a block side by side. Place ``n`` is candidate
``n - abs(slant)``, so that a slanted half finds candidates before the first and after the last.
Only the places of offered candidates are summed, early enough for the first window that needs them.
"""

from __future__ import annotations

from typing import Any, Final, NamedTuple

import numpy as np
from numpy.typing import NDArray

from recon.core.kernels.compiled import Bool, Float32, Int64, UInt8, UInt16, kernel
from recon.stereo.kernels.minima import continue_row
from recon.stereo.kernels.simd.vectors import (
    LANES,
    absolute_difference,
    load,
    smaller,
    splat,
    store,
    widen,
)

_CACHE_BYTES: Final = 1024 * 1024  # of the ring of half windows: what L2 caches commonly hold
_CHUNK: Final = 16  # candidates whose columns are summed at a time: their sums stay in the L1 cache
BLOCK: Final = 1024  # most columns of a block


class Search(NamedTuple):
    """What is searched, and over which windows."""

    ndisp: int  # number of candidates
    minimum: int  # disparity of candidate 0, pixels
    radius: int  # half width of the window, pixels: it is ``2·radius + 1`` wide
    rows_radius: int  # half height of the window, pixels
    cost_cap: int  # largest cost of one pixel; times the pixels of both halves it is < 65535
    #: By how many candidates the lower half of the slanted window is moved up and its upper half
    #: down; 0 = there is no such window.
    slant: int


class Views(NamedTuple):
    """Both images, continued by their border pixels."""

    left: UInt8  # (H, C); column ``c`` is column ``c - radius`` of the image
    #: (H, C + n - 1), n = ndisp + 2·abs(slant); column ``c`` sees candidate ``k`` at column
    #: ``c + n - 1 - abs(slant) - k``.
    right: UInt8
    width: int  # columns of the image


class Scratch(NamedTuple):
    """Scratch memory; its content does not matter."""

    #: uint8 or uint16 (n·S + ...,), sums over one column of a half, place by place.
    columns: NDArray[Any]
    pairs: NDArray[Any]  # uint8 or uint16 (CHUNK·S + ...,), sums over two columns
    fours: UInt16  # (CHUNK·S + ...,), sums over four columns
    halves: UInt16  # (rows_radius + 1, n·S), a ring of rows: sums over a half
    alive: Bool  # (n,), whether the column sums of a place are up to date
    #: (N, 2), first place and the one after the last of each run of places that are summed;
    #: unused rows are 0.
    runs: Int64
    offers: Int64  # as ``runs``, the candidates that are offered
    found: UInt16  # (5·LANES,), results of the last vector of a row, which may be cut short
    stride: int  # columns of a block including those that only its windows reach, S


class Halves(NamedTuple):
    """Sums over both halves of the windows of a row."""

    upper: UInt16  # (n·S,), over the rows above a pixel and its own
    lower: UInt16  # (n·S,), over its own row and those below
    stride: int  # as in `Scratch`, S


def empty_views(search: Search, block: int, height: int, width: int) -> Views:
    """Return memory for `lay_out` to write to, where ``block`` columns are done at a time."""
    columns = width + _stride(search, block)
    right = np.empty((height, columns + _places(search) - 1), np.uint8)
    return Views(np.empty((height, columns), np.uint8), right, width)


@kernel
def lay_out(left: UInt8, right: UInt8, search: Search, first: int, views: Views) -> None:
    """Copy rows (N, W) of both images, from row ``first`` on, to where the search reads them."""
    places = views.right.shape[1] - views.left.shape[1] + 1
    right_at = search.radius + search.minimum - abs(search.slant) + places - 1
    for n in range(len(left)):
        continue_row(left[n], search.radius, views.left[first + n])
        continue_row(right[n], right_at, views.right[first + n])


def empty_scratch(search: Search, block: int) -> Scratch:
    """Return memory for one thread's search, ``block`` columns at a time."""
    places, stride = _places(search), _stride(search, block)
    rows = search.rows_radius + 1
    narrow = [np.uint8 if n * rows * search.cost_cap <= 255 else np.uint16 for n in (1, 2)]
    # The last vectors read beyond the end; their sums are not used.
    beyond = 2 * search.radius + 1 + LANES
    return Scratch(
        columns=np.zeros(places * stride + beyond, narrow[0]),
        pairs=np.zeros(_CHUNK * stride + beyond, narrow[1]),
        fours=np.zeros(_CHUNK * stride + beyond, np.uint16),
        halves=np.empty((rows, places * stride), np.uint16),
        alive=np.zeros(places, np.bool_),
        runs=np.zeros((-(-search.ndisp // (2 * GROUP)) + 1, 2), np.int64),
        offers=np.zeros((-(-search.ndisp // (2 * GROUP)) + 1, 2), np.int64),
        found=np.empty(5 * LANES, np.uint16),
        stride=stride,
    )


def widest_block(search: Search, width: int) -> int:
    """Columns to do at a time where every candidate is searched: as many as the cache holds."""
    bytes_per_column = 2 * (search.rows_radius + 1) * _places(search)
    widest = max(_CACHE_BYTES // bytes_per_column, 64 + 2 * search.radius)
    blocks = -(-width // min(widest - 2 * search.radius, BLOCK))
    return _stride(search, -(-width // blocks)) - 2 * search.radius


def _places(search: Search) -> int:
    return search.ndisp + 2 * abs(search.slant)


def _stride(search: Search, block: int) -> int:
    """Return columns of a block including those that only its windows reach, a multiple of 32."""
    return -(-(block + 2 * search.radius) // 32) * 32


@kernel
def next_half(
    views: Views, search: Search, first: int, y: int, x0: int, scratch: Scratch
) -> Halves:
    """Sum the half window below row ``y``; return it with the half above."""
    rows, start = search.rows_radius + 1, first - search.rows_radius
    last = views.left.shape[0] - 1
    come, gone = min(max(y + rows - 1, 0), last), min(max(y - 1, 0), last)
    lower = scratch.halves[(y - start) % rows]
    for run in range(scratch.runs.shape[0]):
        n0, n1 = scratch.runs[run]
        if n0 == n1:
            break
        _slide_row(views, n0, n1, search.cost_cap, come, gone, x0, scratch)
        for n in range(n0, n1, _CHUNK):
            at, stop = n * scratch.stride, min(n + _CHUNK, n1) * scratch.stride
            _sum_columns(scratch, at, stop, 2 * search.radius + 1, lower)
    # The half above row y is that below row y - rows_radius, the oldest of the ring.
    upper = scratch.halves[(y - start + 1) % rows]
    return Halves(upper, lower, scratch.stride)


@kernel
def offer_candidates(
    views: Views, search: Search, now: Offer, soon: Offer, y: int, x0: int, scratch: Scratch
) -> None:
    """From row ``y`` on offer the candidates of groups ``now``, in a block from column ``x0`` on.

    Sum these and those of the groups ``soon``, bool (G,): what is offered when the half below row
    ``y`` will be an upper one.
    """
    _list_runs(now, now, search.ndisp, 0, scratch.offers)
    _list_runs(now, soon, search.ndisp, 2 * abs(search.slant), scratch.runs)
    _begin(views, search, y - 1, x0, scratch)


@kernel
def _list_runs(now: Offer, soon: Offer, ndisp: int, more: int, runs: Int64) -> None:
    """Write the runs of what is offered now or soon, each ``more`` places longer."""
    count = 0
    runs[:] = 0
    for group in range(now.size):
        if now[group] or soon[group]:
            start, end = group * GROUP, min((group + 1) * GROUP, ndisp) + more
            if count == 0 or runs[count - 1, 1] < start:
                runs[count, 0] = start
                count += 1
            runs[count - 1, 1] = end


@kernel
def _begin(views: Views, search: Search, y: int, x0: int, scratch: Scratch) -> None:
    """Bring the column sums of the runs up to date for row ``y``."""
    last, before = views.left.shape[0] - 1, 0
    for run in range(scratch.runs.shape[0]):
        n0, n1 = scratch.runs[run]
        for n in range(n0, n1):
            if not scratch.alive[n]:
                scratch.columns[n * scratch.stride : (n + 1) * scratch.stride] = 0
                for row in range(y, y + search.rows_radius + 1):
                    at = min(max(row, 0), last)
                    _add_row(views, n, search.cost_cap, at, x0, scratch)
        # Between the runs no sums are updated.
        scratch.alive[before : max(n0, before)] = False
        scratch.alive[n0:n1] = True
        before = max(n1, before)
    scratch.alive[before:] = False


@kernel
def _add_row(views: Views, n: int, cost_cap: int, y: int, x0: int, scratch: Scratch) -> None:
    sums, left, right = scratch.columns, views.left[y], views.right[y]
    cap, shift = splat(np.uint8(cost_cap)), x0 + scratch.alive.size - 1 - n
    for c in range(0, scratch.stride, LANES):
        plus = smaller(absolute_difference(load(left, x0 + c), load(right, shift + c)), cap)
        at = n * scratch.stride + c
        store(sums, at, load(sums, at) + widen(plus, sums))


@kernel
def _slide_row(
    views: Views, n0: int, n1: int, cost_cap: int, come: int, gone: int, x0: int, scratch: Scratch
) -> None:
    """Subtract the costs of row ``gone`` from the column sums and add those of row ``come``."""
    sums, stride, cap = scratch.columns, scratch.stride, splat(np.uint8(cost_cap))
    right, right_gone = views.right[come], views.right[gone]
    for c in range(x0, x0 + stride, LANES):
        left, left_gone = load(views.left[come], c), load(views.left[gone], c)
        at, other = n0 * stride + c - x0, c + scratch.alive.size - 1 - n0
        for _ in range(n1 - n0):
            plus = smaller(absolute_difference(left, load(right, other)), cap)
            minus = smaller(absolute_difference(left_gone, load(right_gone, other)), cap)
            store(sums, at, load(sums, at) - widen(minus, sums) + widen(plus, sums))
            at, other = at + stride, other - 1


@kernel
def _sum_columns(scratch: Scratch, first: int, end: int, window: int, sums: UInt16) -> None:
    """Write the sums over ``window`` neighbours, an odd number, to ``sums``, (n·S,).

    Places follow one another in memory: the last sums of each reach into the next, and are unused.
    """
    values, pairs, fours = scratch.columns, scratch.pairs, scratch.fours
    for i in range(0, end - first, LANES):
        pair = widen(load(values, first + i), pairs) + widen(load(values, first + i + 1), pairs)
        store(pairs, i, pair)
    for i in range(0, end - first, LANES):
        store(fours, i, widen(load(pairs, i), fours) + widen(load(pairs, i + 2), fours))
    whole, odd = window // 4, window % 4 == 3
    for i in range(0, end - first, LANES):
        total = widen(load(values, first + i + window - 1), sums)
        if odd:
            total = total + widen(load(pairs, i + window - 3), sums)
        for n in range(whole):
            total = total + load(fours, i + 4 * n)
        store(sums, first + i, total)


GROUP: Final = 8  # candidates that are offered or left out together
Offer = Bool  # bool (G,), which groups of candidates are offered


class Tiles(NamedTuple):
    """Which candidates are offered where."""

    offered: Bool  # (I, J, G), by tile and group of candidates
    height: int  # rows of a tile, at least the half height of a window
    width: int  # columns of a tile


class Support(NamedTuple):
    """How much support by matches at half size offers a group of candidates to a tile."""

    margin_x: int  # columns beside a tile whose matches count too, pixels at full size
    margin_y: int  # rows above and below a tile whose matches count too, pixels at full size
    margin: int  # a match supports candidates up to this far from it
    matched: float  # least fraction of matched pixels; with fewer, all candidates are offered
    ratio: float  # least fraction of the matches that support an offered group
    least: int  # least number of matches that support an offered group


def make_tiles(shape: tuple[int, int], size: tuple[int, int], ndisp: int) -> Tiles:
    """Return tiles of some size (rows, columns) that are offered every candidate."""
    across, down = -(-shape[0] // size[0]), -(-shape[1] // size[1])
    return Tiles(np.ones((across, down, -(-ndisp // GROUP)), np.bool_), *size)


@kernel
def offer_supported(
    halved: Float32, minimum: int, ndisp: int, support: Support, first: int, end: int, tiles: Tiles
) -> None:
    """Offer the tiles of some rows those groups of candidates that matches at half size support.

    ``halved`` has the disparities (h, w) at half size, NaN = no match; the rest is in pixels at
    full size, and ``first`` to ``end - 1`` are rows of tiles.
    """
    counts = np.empty(ndisp, np.int64)
    _, columns, groups = tiles.offered.shape
    for i in range(first, end):
        y0, y1 = _reach(i, tiles.height, support.margin_y, halved.shape[0])
        for j in range(columns):
            x0, x1 = _reach(j, tiles.width, support.margin_x, halved.shape[1])
            counts[:] = 0
            matched = _count(halved[y0:y1, x0:x1], minimum, counts)
            least = max(support.ratio * matched, support.least)
            everything = matched < support.matched * (y1 - y0) * (x1 - x0)
            for group in range(groups):
                first = max(group * GROUP - support.margin, 0)
                supporters = counts[first : (group + 1) * GROUP + support.margin].sum()
                tiles.offered[i, j, group] = everything or supporters >= least


@kernel
def _reach(tile: int, size: int, margin: int, halved: int) -> tuple[int, int]:
    """Range at half size that counts for a tile, along one axis: first and one after the last."""
    start, end = tile * size - margin, (tile + 1) * size + margin
    return max(start, 0) // 2, min(end // 2, halved)


@kernel
def _count(halved: Float32, minimum: int, counts: Int64) -> int:
    """Count the matches at each candidate of full size; return their number."""
    matched = 0
    for y in range(halved.shape[0]):
        for x in range(halved.shape[1]):
            if not np.isnan(halved[y, x]):
                k = np.int64(np.rint(2 * halved[y, x])) - minimum
                counts[min(max(k, 0), counts.size - 1)] += 1
                matched += 1
    return matched
