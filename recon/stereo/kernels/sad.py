"""Sums of absolute differences over a window, and the best candidate of each pixel.

Why it is fast: a tile of the image is offered only some candidates (`Tiles`). The inner loops
work on `LANES` neighbouring columns at once (`simd`), with the best so far in registers. A window
consists of two halves (`half_windows`), each of which is summed once for two rows, in blocks of
columns that stay in a core's own cache. Two halves that are shifted against each other make a
slanted window, which costs one more addition than the upright one, not another search.

Ref: K. Mühlmann et al., "Calculating dense disparity maps from color stereo images, an efficient
implementation", IJCV 47, 2002; N. Einecke, J. Eggert, "A multi-block-matching approach for
stereo", IEEE Intelligent Vehicles, 2015 (several windows).
"""

from __future__ import annotations

from typing import TypeAlias

import numpy as np

from recon.core.kernels.compiled import Int64, kernel
from recon.stereo.kernels.half_windows import (
    Halves,
    Scratch,
    Search,
    Tiles,
    Views,
    next_half,
    offer_candidates,
)
from recon.stereo.kernels.minima import NO_COST, Minima, write_right_winners
from recon.stereo.kernels.simd.vectors import (
    LANES,
    Vector,
    load,
    ramp,
    smaller,
    splat,
    store,
    where_equal,
    where_less,
)

Found: TypeAlias = tuple[Vector, Vector, Vector, Vector, Vector, Vector, Vector, Vector]
"""The best so far in `LANES` columns; see `_weigh`."""


@kernel
def sad_minima(
    views: Views,
    search: Search,
    tiles: Tiles,
    first: int,
    end: int,
    scratch: Scratch,
    minima: Minima,
) -> None:
    """Find the best candidate of each pixel of rows ``first`` to ``end - 1``.

    Candidate ``k`` of a pixel is the disparity ``minimum + k``. Its cost is the sum of
    ``min(|left - right|, cost_cap)`` over both halves of the window (the middle row is in both,
    so it counts twice), the images continued by their border pixels; with a slant it is the
    smaller of that and of the same sum where the upper half takes candidate ``k - slant`` and the
    lower ``k + slant``, as on the ground under a camera. Candidates whose right pixel lies outside
    the image do not exist, nor those that a tile is not offered. Of equal costs the smaller
    disparity wins. The costs before and after the best are those of the window that won, the
    upright one if both did. A pixel of the right view is matched to the left pixel that chose it
    at the least cost.
    """
    reach, height = search.rows_radius, tiles.height
    for column in range(tiles.offered.shape[1]):
        x0 = column * tiles.width
        x1 = min(x0 + tiles.width, views.width)
        scratch.alive[:] = False
        for y in range(first - reach, end):
            if y == first - reach or y % height == 0 or (y + reach) % height == 0:
                now = tiles.offered[max(y, first) // height, column]
                soon = tiles.offered[min(y + reach, end - 1) // height, column]
                offer_candidates(views, search, now, soon, y, x0, scratch)
            halves = next_half(views, search, first, y, x0, scratch)
            if y >= first:
                _choose(halves, search, scratch, y, x0, x1, minima)
    for y in range(first, end):
        write_right_winners(search.ndisp, search.minimum, y, minima)


@kernel
def _choose(
    halves: Halves, search: Search, scratch: Scratch, y: int, x0: int, x1: int, minima: Minima
) -> None:
    winner, best, second = minima.winner[y], minima.costs[0, y], minima.costs[3, y]
    before, after = minima.costs[1, y], minima.costs[2, y]
    for x in range(x0, x1, LANES):
        found = _search(halves, search, scratch.offers, x, x - x0, winner.size)
        if x + LANES <= winner.size:
            store(winner, x, found[0])
            store(best, x, found[1])
            store(before, x, found[2])
            store(after, x, found[3])
            store(second, x, found[4])
        else:
            row, rest = scratch.found, winner.size - x
            for n in range(5):
                store(row, n * LANES, found[n])
            winner[x:] = row[:rest]
            best[x:] = row[LANES : LANES + rest]
            before[x:] = row[2 * LANES : 2 * LANES + rest]
            after[x:] = row[3 * LANES : 3 * LANES + rest]
            second[x:] = row[4 * LANES : 4 * LANES + rest]


@kernel
def _search(
    halves: Halves, search: Search, offers: Int64, x: int, column: int, width: int
) -> tuple[Vector, Vector, Vector, Vector, Vector]:
    """Search a vector of columns from ``x`` on: winners, and the four costs of `Minima`."""
    # Candidate k exists in the columns from x + k + ahead to x + k + ahead + width - 1.
    ahead = search.minimum - x
    none = splat(np.uint16(NO_COST))
    found = splat(np.uint16(search.ndisp)), none, none, none, none, none, none, none
    for run in range(offers.shape[0]):
        k0, k1 = max(offers[run, 0], 1 - ahead - width), min(offers[run, 1], LANES - ahead)
        if k0 >= k1:
            continue
        if k1 - 1 + ahead > 0 or k0 + ahead + width < LANES:
            found = _offer_some(halves, search.slant, k0, k1, ahead, width, column, found)
        else:
            found = _offer_all(halves, search.slant, k0, k1, column, found)
    winner, best, second, upright = found[0], found[1], found[2], found[3]
    before = where_less(best, upright, found[5], found[4])
    after = where_less(best, upright, found[7], found[6])
    return winner, best, before, after, second


@kernel
def _offer_all(
    halves: Halves, search_slant: int, k0: int, k1: int, column: int, found: Found
) -> Found:
    """Offer the candidates of a run where all of them exist."""
    upper, lower, stride = halves.upper, halves.lower, halves.stride
    slant = search_slant * stride
    none, one = splat(np.uint16(NO_COST)), splat(np.uint16(1))
    upright_last = slanted_last = none
    prior, number = found[1], splat(np.uint16(k0))
    at = (k0 + abs(search_slant)) * stride + column
    for _ in range(k1 - k0):
        upright = load(upper, at) + load(lower, at)
        slanted = load(upper, at - slant) + load(lower, at + slant)
        best = found[1]
        found = _weigh(upright, slanted, upright_last, slanted_last, number, prior, found)
        prior, upright_last, slanted_last = best, upright, slanted
        number, at = number + one, at + stride
    return found


@kernel
def _offer_some(
    halves: Halves,
    search_slant: int,
    k0: int,
    k1: int,
    ahead: int,
    width: int,
    column: int,
    found: Found,
) -> Found:
    """Offer the candidates of a run, each to those columns where it exists."""
    upper, lower, stride = halves.upper, halves.lower, halves.stride
    slant = search_slant * stride
    none, columns = splat(np.uint16(NO_COST)), ramp(np.uint16(0))
    upright_last = slanted_last = none
    prior = found[1]
    for k in range(k0, k1):
        at = (k + abs(search_slant)) * stride + column
        start, end = max(k + ahead, 0), min(k + ahead + width, LANES)
        place, many = columns - splat(np.uint16(start)), splat(np.uint16(end - start))
        upright = load(upper, at) + load(lower, at)
        slanted = load(upper, at - slant) + load(lower, at + slant)
        upright = where_less(place, many, upright, none)
        slanted = where_less(place, many, slanted, none)
        best, number = found[1], splat(np.uint16(k))
        found = _weigh(upright, slanted, upright_last, slanted_last, number, prior, found)
        prior, upright_last, slanted_last = best, upright, slanted
    return found


@kernel
def _weigh(
    upright: Vector,
    slanted: Vector,
    upright_last: Vector,
    slanted_last: Vector,
    number: Vector,
    prior: Vector,
    found: Found,
) -> Found:
    """Update the best so far by candidate ``number``.

    ``prior`` is the lowest cost of all candidates before the previous one, whose own costs are the
    last. ``found`` is the best so far: its number, its cost, the lowest cost two or more candidates
    away, its cost by the upright window; the costs of the candidate before it and of the one after
    it, each by the upright and by the slanted window.
    """
    winner, best, second, upright_best = found[:4]
    upright_before, slant_before, upright_after, slant_after = found[4:]
    none, last = splat(np.uint16(NO_COST)), number - splat(np.uint16(1))
    cost = smaller(upright, slanted)
    upright_after = where_equal(winner, last, upright, upright_after)
    slant_after = where_equal(winner, last, slanted, slant_after)
    second = where_equal(winner, last, second, smaller(second, cost))
    return (
        where_less(cost, best, number, winner),
        smaller(best, cost),
        where_less(cost, best, prior, second),
        where_less(cost, best, upright, upright_best),
        where_less(cost, best, upright_last, upright_before),
        where_less(cost, best, slanted_last, slant_before),
        where_less(cost, best, none, upright_after),
        where_less(cost, best, none, slant_after),
    )
