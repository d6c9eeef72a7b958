"""Semi-global matching: each pixel's candidates agree with those along paths to it.

Two sweeps, one down and one up, follow half of the paths each. Of a path only the row before is
kept, in uint8; its least cost is taken off at every step, so that no path cost exceeds the cost
of a pixel plus the larger penalty. The rows of a strip are done in small blocks, one after the
other: the sweep down goes on from block to block, the sweep up starts some rows below each, so
that its paths have forgotten where they began. So what passes from one sweep to the other never
leaves the cache: it is the memory, not the arithmetic, that this would wait for.

All paths come from the row before, never along the row: every pixel of a row is a lane of its own,
no minimum is taken across lanes, and no pixel waits for its neighbour. Means of two, rounded up,
take the place of sums: one instruction each, and bytes suffice. The straight path counts twice a
diagonal.

The twin in plain numpy is `recon.kernels.semi_global_reference.semi_global_minima_reference`.

Ref: H. Hirschmüller, "Stereo processing by semiglobal matching and mutual information", PAMI 30,
2008, equations 13 and 14.
"""

from __future__ import annotations

from typing import Final, NamedTuple

import numpy as np
from numba import njit
from numpy.typing import NDArray

from recon.kernels.minima import Minima
from recon.kernels.path_costs import (
    LANES,
    TOGETHER,
    Views,
    Window,
    aligned,
    empty_cost_rows,
    padded,
    write_costs,
)
from recon.kernels.plane_minima import Best, choose_rows, empty_best

DOWN, UP, ASIDE = range(3)
"""What becomes of the means over paths."""

ROWS: Final = 32
"""Rows of a block: few enough for the cache to hold what passes from one sweep to the other."""

MARGIN: Final = LANES
"""Columns on each side of a row of paths, where paths begin."""


class Paths(NamedTuple):
    """What is searched, and what changes along a path cost.

    Attributes:
        ndisp: Number of candidates.
        minimum: Disparity of candidate 0, pixels.
        small: Penalty of a step of one candidate.
        large: Penalty of any other step; `Window.top` + small + large is at most 254.
        large_at_edge: The same where the grey level changes by more than ``edge``.
        edge: Grey levels.
        overlap: Rows that paths start early.
    """

    ndisp: int
    minimum: int
    small: int
    large: int
    large_at_edge: int
    edge: int
    overlap: int


class PathRow(NamedTuple):
    """Path costs of one row; the next row is written over it.

    A path from the left moves its row by one column to the left, so that what is read and what is
    written stand at one place, and one from the right moves it to the right: there is room for
    `MARGIN` - 1 rows, then `_recentre` moves them back. A candidate on each side lets no path in.

    Attributes:
        straight: uint8 (P + 2, MARGIN + C + MARGIN), path from the same column.
        from_left: the same, path from the column to the left.
        from_right: the same, path from the column to the right.
        least: uint8 (2, 3, MARGIN + C + MARGIN), the least of each, before and now.
        below: uint8 (3, C), the costs of the candidate below those that are being done.
        limits: uint8 (3, C), dearest way to a pixel on each path.
    """

    straight: NDArray[np.uint8]
    from_left: NDArray[np.uint8]
    from_right: NDArray[np.uint8]
    least: NDArray[np.uint8]
    below: NDArray[np.uint8]
    limits: NDArray[np.uint8]


class Room(NamedTuple):
    """What a strip is worked on in; the next strip can have it.

    Attributes:
        costs: uint8 (ROWS + overlap, P, C), cost of each candidate at each pixel.
        means: uint8 (ROWS, P, C), means of the path costs of the sweep down.
        above: Paths from above.
        under: Paths from below.
    """

    costs: NDArray[np.uint8]
    means: NDArray[np.uint8]
    above: PathRow
    under: PathRow


def empty_room(width: int, paths: Paths) -> Room:
    """Room for strips of a picture of that width."""
    candidates, columns = padded(paths.ndisp, TOGETHER), padded(width)
    return Room(
        costs=aligned((ROWS + paths.overlap, candidates, columns)),
        means=aligned((ROWS, candidates, columns)),
        above=_empty_row(candidates, columns),
        under=_empty_row(candidates, columns),
    )


def semi_global_minima(
    views: Views, window: Window, paths: Paths, strip: range, room: Room, minima: Minima
) -> None:
    """Find the best candidate of each pixel of a strip, in the left and the right view.

    Candidate ``k`` of a pixel is the disparity ``minimum + k``. Its cost is the mean of the costs
    of the paths that end there. Those from above begin at the border of the picture or ``overlap``
    rows above the strip, those from below ``overlap`` rows below each block.

    Args:
        views: What is compared.
        window: What the cost of a pixel is.
        paths: What is searched.
        strip: The rows.
        room: Enough for the strip; what it holds does not matter.
        minima: Written: the rows of the strip.
    """
    height, width = views.grey.shape
    top = known = max(strip.start - paths.overlap, 0)
    rows, best = (
        empty_cost_rows(width, window),
        empty_best(room.costs.shape[2], room.costs.shape[1]),
    )
    _begin(paths, room.above)
    for first in range(top, strip.stop, ROWS):
        block = range(first, min(first + ROWS, strip.stop))
        bottom = min(block.stop + paths.overlap, height)
        write_costs(views, window, paths.ndisp, known, bottom, rows, room.costs)
        known = bottom
        _sweep_down(views.grey, paths, block, room)
        wanted = range(max(block.start, strip.start), block.stop)
        if wanted:
            below = range(bottom - 1, wanted.start - 1, -1)
            _sweep_up(views.grey, paths, below, wanted, room, best, minima)


def _empty_row(candidates: int, columns: int) -> PathRow:
    row = (candidates + 2, MARGIN + columns + MARGIN)
    return PathRow(
        straight=aligned(row),
        from_left=aligned(row),
        from_right=aligned(row),
        least=aligned((2, 3, row[1])),
        below=aligned((3, columns)),
        limits=aligned((3, columns)),
    )


def _begin(paths: Paths, row: PathRow) -> None:
    """Let paths begin: all their costs are 0, but those of the candidates on the sides."""
    for costs in row[:3]:
        costs[1:-1] = 0
        costs[0] = costs[-1] = np.uint8(255 - paths.small)
    row.least[:] = 0


def _recentre(row: PathRow, moved: int) -> None:
    """Move the paths from the left and from the right back to where they began."""
    columns = row.limits.shape[1]
    for costs, start in ((row.from_left, MARGIN - moved), (row.from_right, MARGIN + moved)):
        costs[1:-1, MARGIN:-MARGIN] = costs[1:-1, start : start + columns].copy()
        costs[1:-1, :MARGIN] = costs[1:-1, -MARGIN:] = 0


def _sweep_down(grey: NDArray[np.uint8], paths: Paths, block: range, room: Room) -> None:
    """Follow the paths that come from above through a block."""
    _follow_down(grey, paths, block.start, block.stop, room)
    _recentre(room.above, len(block))


@njit(cache=True, nogil=True)
def _follow_down(grey: NDArray[np.uint8], paths: Paths, start: int, stop: int, room: Room) -> None:
    """Advance the paths from above row by row, and write their means."""
    for y in range(start, stop):
        costs, means = room.costs[y % room.costs.shape[0]], room.means[y % ROWS]
        _advance(costs, grey, y, max(y - 1, 0), paths, room.above, y - start, means, DOWN)


def _sweep_up(
    grey: NDArray[np.uint8],
    paths: Paths,
    below: range,
    wanted: range,
    room: Room,
    best: Best,
    minima: Minima,
) -> None:
    """Follow the paths that come from below, and choose in the rows that are wanted."""
    _begin(paths, room.under)
    for n in range(0, len(below), ROWS):
        part = below[n : n + ROWS]
        _follow_up(grey, paths, part[0], part[-1], wanted.stop, room)
        _recentre(room.under, len(part))
    first, end = wanted.start, wanted.stop
    choose_rows(room.means, paths.ndisp, paths.minimum, first, end, best, minima)


@njit(cache=True, nogil=True)
def _follow_up(
    grey: NDArray[np.uint8], paths: Paths, start: int, last: int, stop: int, room: Room
) -> None:
    """Advance the paths from below row by row; above ``stop``, take them into the means."""
    for y in range(start, last - 1, -1):
        costs, means = room.costs[y % room.costs.shape[0]], room.means[y % ROWS]
        before, stage = min(y + 1, grey.shape[0] - 1), UP if y < stop else ASIDE
        _advance(costs, grey, y, before, paths, room.under, start - y, means, stage)


@njit(cache=True, nogil=True)
def _advance(
    costs: NDArray[np.uint8],
    grey: NDArray[np.uint8],
    y: int,
    y_before: int,
    paths: Paths,
    row: PathRow,
    moved: int,
    means: NDArray[np.uint8],
    stage: int,
) -> None:
    """Advance the paths of a sweep by one row, and write means over them (`_average`)."""
    before, now, limits, below = row.least[0], row.least[1], row.limits, row.below
    width, columns = grey.shape[1], costs.shape[1]
    left, right = MARGIN - 1 - moved, MARGIN + 1 + moved
    for n, side in enumerate((0, -1, 1)):
        first, end = max(-side, 0), min(width - side, width)
        beside = before[n, MARGIN + first + side : MARGIN + end + side]
        others = grey[y_before, first + side : end + side]
        _set_limits(grey[y, first:end], others, beside, paths, limits[n, first:end])
        now[n, MARGIN : MARGIN + columns] = np.uint8(255)
    below[:] = np.uint8(255 - paths.small)
    small = paths.small
    for k in range(0, costs.shape[0], TOGETHER):
        _advance_path(
            costs, k, row.straight, MARGIN, before[0], 0, limits[0], small, below[0], now[0]
        )
        _advance_path(
            costs, k, row.from_left, left, before[1], -1, limits[1], small, below[1], now[1]
        )
        _advance_path(
            costs, k, row.from_right, right, before[2], 1, limits[2], small, below[2], now[2]
        )
        # Beyond the last column paths begin.
        row.from_right[k + 1 : k + 1 + TOGETHER, right + width] = np.uint8(0)
        for n in range(k, k + TOGETHER):
            _average(
                row.straight[n + 1, MARGIN:],
                row.from_left[n + 1, left:],
                row.from_right[n + 1, right:],
                means[n],
                stage,
            )
    now[2, MARGIN + width] = np.uint8(0)
    before[:] = now


@njit(cache=True, nogil=True)
def _set_limits(
    grey: NDArray[np.uint8],
    others: NDArray[np.uint8],
    least: NDArray[np.uint8],
    paths: Paths,
    limits: NDArray[np.uint8],
) -> None:
    """Write the least cost of a path's row before, plus the larger penalty on its way."""
    edge, large = np.uint8(paths.edge), np.uint8(paths.large)
    large_at_edge = np.uint8(paths.large_at_edge)
    for x in range(limits.size):
        step = np.uint8(max(grey[x], others[x]) - min(grey[x], others[x]))
        limits[x] = np.uint8(least[x] + (large_at_edge if step > edge else large))


@njit(cache=True, nogil=True)
def _advance_path(
    costs: NDArray[np.uint8],
    k: int,
    paths: NDArray[np.uint8],
    start: int,
    least: NDArray[np.uint8],
    side: int,
    limit: NDArray[np.uint8],
    small: int,
    below: NDArray[np.uint8],
    fresh: NDArray[np.uint8],
) -> None:
    """Advance four candidates of one path; what they share is loaded once."""
    penalty, size = np.uint8(small), costs.shape[1]
    first, second = paths[k + 1, start : start + size], paths[k + 2, start : start + size]
    third, fourth = paths[k + 3, start : start + size], paths[k + 4, start : start + size]
    above = paths[k + 5, start : start + size]
    for x in range(size):
        a, b, c, d = first[x], second[x], third[x], fourth[x]
        low, high = least[x + MARGIN + side], limit[x]
        beside = np.uint8(min(below[x], b) + penalty)
        p = np.uint8(np.uint8(min(a, beside, high) - low) + costs[k, x])
        beside = np.uint8(min(a, c) + penalty)
        q = np.uint8(np.uint8(min(b, beside, high) - low) + costs[k + 1, x])
        beside = np.uint8(min(b, d) + penalty)
        r = np.uint8(np.uint8(min(c, beside, high) - low) + costs[k + 2, x])
        beside = np.uint8(min(c, above[x]) + penalty)
        s = np.uint8(np.uint8(min(d, beside, high) - low) + costs[k + 3, x])
        first[x], second[x], third[x], fourth[x], below[x] = p, q, r, s, d
        fresh[x + MARGIN] = min(fresh[x + MARGIN], p, q, r, s)


@njit(cache=True, nogil=True)
def _mean(a: np.uint8, b: np.uint8) -> np.uint8:
    """Mean of two, rounded up."""
    one = np.uint16(1)
    total = np.uint16(np.uint16(np.uint16(a) + np.uint16(b)) + one)
    mean: np.uint8 = np.uint8(np.uint16(total >> one))
    return mean


@njit(cache=True, nogil=True)
def _average(
    straight: NDArray[np.uint8],
    from_left: NDArray[np.uint8],
    from_right: NDArray[np.uint8],
    means: NDArray[np.uint8],
    stage: int,
) -> None:
    """Write the means over a candidate's paths (DOWN), or take them into those written (UP)."""
    if stage == DOWN:
        for x in range(means.size):
            diagonal = _mean(from_left[x], from_right[x])
            means[x] = _mean(straight[x], diagonal)
    elif stage == UP:
        for x in range(means.size):
            diagonal = _mean(from_left[x], from_right[x])
            means[x] = _mean(means[x], _mean(straight[x], diagonal))
