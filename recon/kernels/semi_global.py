"""Semi-global matching: each pixel's candidates agree with those along paths to it.

Two sweeps over a strip of rows, one down and one up, follow half of the paths each. Of a path
only the row before is kept, in uint8; its least cost is taken off at every step, so that no path
cost exceeds the cost of a pixel plus the larger penalty. The four paths of a sweep advance in
one loop: it is the loop that vectorises best. A strip starts some rows early, so that its paths
have forgotten where they began; what it needs of memory does not grow with the picture's height.
Between the sweeps the sums over paths wait as rounded means, in uint8: the traffic to memory
costs more than their last two bits are worth.

The twin in plain numpy is `recon.kernels.semi_global_reference.semi_global_minima_reference`.

Ref: H. Hirschmüller, "Stereo processing by semiglobal matching and mutual information", PAMI 30,
2008, equations 13 and 14.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from numba import njit
from numpy.typing import NDArray

from recon.kernels.minima import Minima, left_minima, right_minima
from recon.kernels.path_costs import (
    Views,
    Window,
    empty_cost_rows,
    enter_row,
    padded_candidates,
    write_costs,
)


class Paths(NamedTuple):
    """What is searched, and what changes along a path cost.

    Attributes:
        ndisp: Number of candidates.
        minimum: Disparity of candidate 0, pixels.
        small: Penalty of a step of one candidate.
        large: Penalty of any other step; `Window.top` + small + large is at most 255.
        large_at_edge: The same where the grey level changes by more than ``edge``.
        edge: Grey levels.
        diagonal: Eight paths; else the four along rows and columns.
        overlap: Rows that a strip starts early.
    """

    ndisp: int
    minimum: int
    small: int
    large: int
    large_at_edge: int
    edge: int
    diagonal: bool
    overlap: int


class PathRow(NamedTuple):
    """Path costs of one row, with a border of one pixel and one candidate on each side.

    Attributes:
        straight: uint8 (W + 2, P + 2), path that comes from the row before, same column.
        from_left: the same, path that comes from the column to the left.
        from_right: the same, path that comes from the column to the right.
        along: the same, path that comes along the row.
        least: uint8 (3, W + 2), the least of each of the first three.
        limits: uint8 (4, W), larger penalty on each path's way to a pixel.
    """

    straight: NDArray[np.uint8]
    from_left: NDArray[np.uint8]
    from_right: NDArray[np.uint8]
    along: NDArray[np.uint8]
    least: NDArray[np.uint8]
    limits: NDArray[np.uint8]


class Room(NamedTuple):
    """What a strip is worked on in; the next strip can have it.

    Attributes:
        costs: uint8 (rows + 2·overlap, W, P), cost of each candidate at each pixel.
        means: uint8 (rows, W, ndisp), means of the path costs of the sweep down.
    """

    costs: NDArray[np.uint8]
    means: NDArray[np.uint8]


def empty_room(rows: int, width: int, paths: Paths) -> Room:
    """Room for strips of so many rows or fewer."""
    high = rows + 2 * paths.overlap
    return Room(
        costs=np.empty((high, width, padded_candidates(paths.ndisp)), np.uint8),
        means=np.empty((rows, width, paths.ndisp), np.uint8),
    )


def semi_global_minima(
    views: Views, window: Window, paths: Paths, strip: range, room: Room, minima: Minima
) -> None:
    """Find the best candidate of each pixel of a strip, in the left and the right view.

    Candidate ``k`` of a pixel is the disparity ``minimum + k``. Its cost is the sum of the costs
    of the paths that end there, which begin at the border of the picture or ``overlap`` rows
    outside the strip; those of the sweep down enter as their rounded mean. The rows are driven
    from here, since the loops below lose their vector instructions when they are compiled into
    one function with the arrays they work on.

    Args:
        views: What is compared.
        window: What the cost of a pixel is.
        paths: What is searched.
        strip: The rows.
        room: Enough for the strip; what it holds does not matter.
        minima: Written: the rows of the strip.
    """
    height = len(views.grey)
    top, bottom = max(strip.start - paths.overlap, 0), min(strip.stop + paths.overlap, height)
    reach = range(top, bottom)
    _sweep_down(views, window, paths, strip, reach, room)
    _sweep_up(views.grey, paths, strip, reach, room, minima)


def _sweep_down(
    views: Views, window: Window, paths: Paths, strip: range, reach: range, room: Room
) -> None:
    """Compute the costs of the rows within reach, and follow the paths that come from above."""
    top, width, candidates = reach.start, *room.costs.shape[1:]
    grey = _widened(views.grey)
    rows = empty_cost_rows(width, candidates, window)
    before, now = _begin(paths, width, candidates), _begin(paths, width, candidates)
    for y in range(top - window.rows_radius, top + window.rows_radius):
        enter_row(views, window, y, rows)
    for y in reach:
        enter_row(views, window, y + window.rows_radius, rows)
        write_costs(rows, window, paths.ndisp, y - top, room.costs)
        if y < strip.stop:
            costs = room.costs[y - top]
            _advance(costs, grey[y], grey[max(y - 1, 0)], 1, paths, before, now)
            if y in strip:
                _store_means(now, paths.diagonal, room.means[y - strip.start])
            before, now = now, before


def _sweep_up(
    grey: NDArray[np.uint8], paths: Paths, strip: range, reach: range, room: Room, minima: Minima
) -> None:
    """Follow the paths that come from below, and choose."""
    height, width = grey.shape
    grey, candidates = _widened(grey), room.costs.shape[2]
    before, now = _begin(paths, width, candidates), _begin(paths, width, candidates)
    right_best = np.empty((2, width + paths.ndisp), np.uint16)
    sums = np.empty((width, paths.ndisp), np.uint16)
    for y in reversed(reach):
        costs = room.costs[y - reach.start]
        _advance(costs, grey[y], grey[min(y + 1, height - 1)], -1, paths, before, now)
        if y in strip:
            _sum_paths(now, paths.diagonal, room.means[y - strip.start], sums)
            left_minima(sums, y, paths.minimum, minima)
            right_minima(sums, y, paths.minimum, right_best, minima.right_winner)
        before, now = now, before


def _widened(grey: NDArray[np.uint8]) -> NDArray[np.uint8]:
    """The picture with one more column at each side."""
    return np.pad(grey, ((0, 0), (1, 1)), mode="edge")


def _begin(paths: Paths, width: int, candidates: int) -> PathRow:
    """A row of paths that begin: all their costs are 0."""
    diagonals = width if paths.diagonal else 0
    return PathRow(
        _closed(paths, width, candidates),
        _closed(paths, diagonals, candidates),
        _closed(paths, diagonals, candidates),
        _closed(paths, width, candidates),
        np.zeros((3, width + 2), np.uint8),
        np.empty((4, width), np.uint8),
    )


def _closed(paths: Paths, width: int, candidates: int) -> NDArray[np.uint8]:
    """Path costs 0, with candidates on both sides that no path comes from."""
    costs = np.zeros((width + 2, candidates + 2), np.uint8)
    costs[:, 0] = costs[:, -1] = np.uint8(255 - paths.small)
    return costs


@njit(cache=True, nogil=True)
def _advance(
    costs: NDArray[np.uint8],
    grey: NDArray[np.uint8],
    grey_before: NDArray[np.uint8],
    step: int,
    paths: Paths,
    before: PathRow,
    now: PathRow,
) -> None:
    """Advance the paths of a sweep by one row; ``step`` is the way along the row, 1 or -1."""
    _set_limits(grey, grey_before, step, paths, now.limits)
    if paths.diagonal:
        _advance_four(costs, step, paths.small, before, now)
    else:
        _advance_two(costs, step, paths.small, before, now)


@njit(cache=True, nogil=True)
def _set_limits(
    grey: NDArray[np.uint8],
    grey_before: NDArray[np.uint8],
    step: int,
    paths: Paths,
    limits: NDArray[np.uint8],
) -> None:
    """Write the larger penalties of a row: straight, from left, from right, along the row.

    The rows of grey levels have one more at each end, so that the loops need not look for it.
    """
    end = grey.size - 1
    here = grey[1:end]
    _set_penalties(here, grey_before[1:end], paths, limits[0])
    _set_penalties(here, grey_before[: end - 1], paths, limits[1])
    _set_penalties(here, grey_before[2:], paths, limits[2])
    _set_penalties(here, grey[: end - 1] if step > 0 else grey[2:], paths, limits[3])


@njit(cache=True, nogil=True)
def _set_penalties(
    grey: NDArray[np.uint8], others: NDArray[np.uint8], paths: Paths, limits: NDArray[np.uint8]
) -> None:
    """Write the larger penalties between grey levels."""
    edge, large = np.uint8(paths.edge), np.uint8(paths.large)
    large_at_edge = np.uint8(paths.large_at_edge)
    for x in range(limits.size):
        step = np.uint8(max(grey[x], others[x]) - min(grey[x], others[x]))
        limits[x] = large_at_edge if step > edge else large


@njit(cache=True, nogil=True)
def _advance_four(
    costs: NDArray[np.uint8], step: int, small: int, before: PathRow, now: PathRow
) -> None:
    """Advance the straight path, both diagonals, and the path along the row."""
    p0, p1, p2, side = before.straight, before.from_left, before.from_right, now.along
    n0, n1, n2, limits = now.straight, now.from_left, now.from_right, now.limits
    width, candidates = costs.shape
    penalty, m3 = np.uint8(small), np.uint8(0)
    side[0 if step > 0 else width + 1, 1:-1] = np.uint8(0)
    for n in range(width):
        x = n if step > 0 else width - 1 - n
        back = x + 1 - step
        m0, m1, m2 = before.least[0, x + 1], before.least[1, x], before.least[2, x + 2]
        l0, l1 = np.uint8(m0 + limits[0, x]), np.uint8(m1 + limits[1, x])
        l2, l3 = np.uint8(m2 + limits[2, x]), np.uint8(m3 + limits[3, x])
        r0 = r1 = r2 = r3 = np.uint8(255)
        for k in range(candidates):
            cost = costs[x, k]
            beside = np.uint8(min(p0[x + 1, k], p0[x + 1, k + 2]) + penalty)
            v0 = np.uint8(np.uint8(min(p0[x + 1, k + 1], beside, l0) - m0) + cost)
            beside = np.uint8(min(p1[x, k], p1[x, k + 2]) + penalty)
            v1 = np.uint8(np.uint8(min(p1[x, k + 1], beside, l1) - m1) + cost)
            beside = np.uint8(min(p2[x + 2, k], p2[x + 2, k + 2]) + penalty)
            v2 = np.uint8(np.uint8(min(p2[x + 2, k + 1], beside, l2) - m2) + cost)
            beside = np.uint8(min(side[back, k], side[back, k + 2]) + penalty)
            v3 = np.uint8(np.uint8(min(side[back, k + 1], beside, l3) - m3) + cost)
            n0[x + 1, k + 1], n1[x + 1, k + 1] = v0, v1
            n2[x + 1, k + 1], side[x + 1, k + 1] = v2, v3
            r0, r1, r2, r3 = min(r0, v0), min(r1, v1), min(r2, v2), min(r3, v3)
        now.least[0, x + 1], now.least[1, x + 1], now.least[2, x + 1] = r0, r1, r2
        m3 = r3


@njit(cache=True, nogil=True)
def _advance_two(
    costs: NDArray[np.uint8], step: int, small: int, before: PathRow, now: PathRow
) -> None:
    """Advance the straight path and the one along the row."""
    p0, n0, side, limits = before.straight, now.straight, now.along, now.limits
    width, candidates = costs.shape
    penalty, m3 = np.uint8(small), np.uint8(0)
    side[0 if step > 0 else width + 1, 1:-1] = np.uint8(0)
    for n in range(width):
        x = n if step > 0 else width - 1 - n
        back = x + 1 - step
        m0 = before.least[0, x + 1]
        l0, l3 = np.uint8(m0 + limits[0, x]), np.uint8(m3 + limits[3, x])
        r0 = r3 = np.uint8(255)
        for k in range(candidates):
            cost = costs[x, k]
            beside = np.uint8(min(p0[x + 1, k], p0[x + 1, k + 2]) + penalty)
            v0 = np.uint8(np.uint8(min(p0[x + 1, k + 1], beside, l0) - m0) + cost)
            beside = np.uint8(min(side[back, k], side[back, k + 2]) + penalty)
            v3 = np.uint8(np.uint8(min(side[back, k + 1], beside, l3) - m3) + cost)
            n0[x + 1, k + 1], side[x + 1, k + 1] = v0, v3
            r0, r3 = min(r0, v0), min(r3, v3)
        now.least[0, x + 1], m3 = r0, r3


@njit(cache=True, nogil=True)
def _store_means(now: PathRow, diagonal: bool, means: NDArray[np.uint8]) -> None:
    """Write the means over the paths of the sweep down, rounded."""
    n0, n1, n2, n3 = now.straight, now.from_left, now.from_right, now.along
    one, two = np.uint16(1), np.uint16(2)
    for x in range(means.shape[0]):
        if diagonal:
            for k in range(means.shape[1]):
                pair = np.uint16(np.uint16(n0[x + 1, k + 1]) + np.uint16(n3[x + 1, k + 1]))
                other = np.uint16(np.uint16(n1[x + 1, k + 1]) + np.uint16(n2[x + 1, k + 1]))
                means[x, k] = np.uint8(np.uint16(np.uint16(pair + other) + two) >> two)
        else:
            for k in range(means.shape[1]):
                pair = np.uint16(np.uint16(n0[x + 1, k + 1]) + np.uint16(n3[x + 1, k + 1]))
                means[x, k] = np.uint8(np.uint16(pair + one) >> one)


@njit(cache=True, nogil=True)
def _sum_paths(
    now: PathRow, diagonal: bool, means: NDArray[np.uint8], sums: NDArray[np.uint16]
) -> None:
    """Add the paths of the sweep up to those of the sweep down, means times their number."""
    n0, n1, n2, n3 = now.straight, now.from_left, now.from_right, now.along
    one, two = np.uint16(1), np.uint16(2)
    for x in range(sums.shape[0]):
        if diagonal:
            for k in range(sums.shape[1]):
                pair = np.uint16(np.uint16(n0[x + 1, k + 1]) + np.uint16(n3[x + 1, k + 1]))
                other = np.uint16(np.uint16(n1[x + 1, k + 1]) + np.uint16(n2[x + 1, k + 1]))
                down = np.uint16(np.uint16(means[x, k]) << two)
                sums[x, k] = np.uint16(np.uint16(pair + other) + down)
        else:
            for k in range(sums.shape[1]):
                pair = np.uint16(np.uint16(n0[x + 1, k + 1]) + np.uint16(n3[x + 1, k + 1]))
                sums[x, k] = np.uint16(pair + np.uint16(np.uint16(means[x, k]) << one))
