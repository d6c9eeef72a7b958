"""Semi-global matching: each pixel's candidates agree with those along paths to it.

Two sweeps, one down and one up, follow three paths each; the one that goes up follows the two along
each row as well. Paths are kept in uint8; their least cost is taken off at every step, so that no
path cost exceeds the cost of a pixel plus the larger penalty. A strip of rows is done in bands of
columns, and a band in blocks of rows, one after the other: the sweep down goes on from block to
block, the sweep up starts some rows below each, and a band is a little wider than what is kept of
it, so that paths have forgotten where they began. So what passes from one sweep to the other never
leaves the cache: it is the memory, not the arithmetic, that this would wait for.

The twin in plain numpy is `recon.kernels.semi_global_reference.semi_global_minima_reference`.

Ref: H. Hirschmüller, "Stereo processing by semiglobal matching and mutual information", PAMI 30,
2008, equations 13 and 14.
"""

from __future__ import annotations

from typing import Final, NamedTuple

import numpy as np
from numba import njit
from numpy.typing import NDArray

from recon.kernels.lanes import LANES
from recon.kernels.minima import Minima
from recon.kernels.path_across import Across, empty_across, follow_row
from recon.kernels.path_costs import (
    CostRows,
    Views,
    Window,
    aligned,
    empty_cost_rows,
    padded,
    write_costs,
)
from recon.kernels.path_rows import ASIDE, DOWN, UP, PathRow, Paths, advance, begin
from recon.kernels.plane_minima import MARGIN, NONE, Band, Best, choose_row, empty_best

ROWS: Final = 32
"""Rows of a block: many beside those that the sweep up starts below it."""

ROOM_BYTES: Final = 4 << 20
"""What passes from one sweep to the other should not take more, or it leaves the cache."""


class Room(NamedTuple):
    """What a strip is worked on in; the next strip can have it.

    Attributes:
        memory: uint8 (N), enough for a band.
        columns: Columns of a band, but of the last, which may have fewer.
    """

    memory: NDArray[np.uint8]
    columns: int


class Bench(NamedTuple):
    """What a band of C columns is worked on in, all uint8.

    Attributes:
        costs: (ROWS + overlap, P, C), cost of each candidate at each pixel.
        means: (ROWS, P, MARGIN + C + MARGIN), means of the path costs of the sweep down; the
            margins are `NONE`.
        above: Paths from above.
        under: Paths from below.
        across: Paths along the row.
    """

    costs: NDArray[np.uint8]
    means: NDArray[np.uint8]
    above: PathRow
    under: PathRow
    across: Across


def empty_room(width: int, paths: Paths) -> Room:
    """Room for strips of a picture of that width."""
    columns = band_columns(width, paths)
    return Room(aligned((room_bytes(columns, paths),)), columns)


def band_columns(width: int, paths: Paths) -> int:
    """How wide bands of a picture of that width are."""
    most = ROOM_BYTES // (paths.ndisp * (2 * ROWS + paths.overlap)) // LANES * LANES
    # What a band shares should be less than what is its own.
    least = padded(4 * paths.side_overlap + 1)
    return min(padded(width), max(most, least))


def room_bytes(columns: int, paths: Paths) -> int:
    """What a band of so many columns takes."""
    return sum(int(np.prod(shape)) for shape in _shapes(columns, paths))


def _shapes(columns: int, paths: Paths) -> list[tuple[int, ...]]:
    """Shapes of what makes up a `Bench`."""
    wide = MARGIN + columns + MARGIN
    row = [(3, paths.ndisp + 2, wide), (2, 3, wide), (3, columns), (3, columns)]
    costs, means = (ROWS + paths.overlap, paths.ndisp, columns), (ROWS, paths.ndisp, wide)
    return [costs, means, *row, *row]


def _bench(room: Room, columns: int, paths: Paths) -> Bench:
    """Divide a room for a band."""
    arrays, start = [], 0
    for shape in _shapes(columns, paths):
        size = int(np.prod(shape))
        arrays.append(room.memory[start : start + size].reshape(shape))
        start += size
    costs, means = arrays[:2]
    means[..., :MARGIN] = means[..., -MARGIN:] = NONE
    return Bench(
        costs, means, PathRow(*arrays[2:6]), PathRow(*arrays[6:]), empty_across(columns, paths)
    )


def semi_global_minima(
    views: Views, window: Window, paths: Paths, strip: range, room: Room, minima: Minima
) -> None:
    """Find the best candidate of each pixel of a strip, in the left and the right view.

    Candidate ``k`` of a pixel is the disparity ``minimum + k``. Its cost is the mean of the costs
    of the paths that end there. Those from above begin at the border of the picture or ``overlap``
    rows above the strip, those from below ``overlap`` rows below each block, those along a row
    and those from the side at the border of the picture or ``side_overlap`` columns beside each
    band.

    Args:
        views: What is compared.
        window: What the cost of a pixel is.
        paths: What is searched.
        strip: The rows.
        room: Enough for the strip; what it holds does not matter.
        minima: Written: the rows of the strip.
    """
    width = views.grey.shape[1]
    rows = empty_cost_rows(room.columns, window)
    best = empty_best(room.columns, width, len(strip))
    minima.right_winner[strip.start : strip.stop] = paths.ndisp
    bench = None
    for band in bands_of(width, room.columns, window, paths):
        if bench is None or padded(band.end - band.start) != bench.costs.shape[2]:
            bench = _bench(room, padded(band.end - band.start), paths)
        _search_band(views, window, paths, strip, band, bench, rows, best, minima)


def bands_of(width: int, columns: int, window: Window, paths: Paths) -> list[Band]:
    """Divide a picture of that width among bands that overlap, in a room for so many columns."""
    if columns < width:
        # With the window's sides, a band fills vectors of lanes.
        columns -= 2 * window.radius
    overlap = paths.side_overlap
    bands, first = [], 0
    while first < width:
        start = max(first - overlap, 0)
        end = min(start + columns, width)
        last = end if end == width else end - overlap
        bands.append(Band(start, end, first, last))
        first = last
    return bands


def _search_band(
    views: Views,
    window: Window,
    paths: Paths,
    strip: range,
    band: Band,
    bench: Bench,
    rows: CostRows,
    best: Best,
    minima: Minima,
) -> None:
    """Find the best candidates of a strip within a band."""
    known = top = max(strip.start - paths.overlap, 0)
    begin(paths, bench.above)
    for first in range(top, strip.stop, ROWS):
        end = min(first + ROWS, strip.stop)
        bottom = min(end + paths.overlap, len(views.grey))
        write_costs(views, window, band[:2], known, bottom, rows, bench.costs)
        known = bottom
        _sweep_down(views.grey, paths, band, first, end, bench)
        wanted = max(first, strip.start)
        if wanted < end:
            begin(paths, bench.under)
            place = wanted - strip.start
            _sweep_up(views.grey, paths, band, bottom, wanted, end, place, bench, best, minima)


@njit(cache=True, nogil=True)
def _sweep_down(
    grey: NDArray[np.uint8], paths: Paths, band: Band, first: int, end: int, bench: Bench
) -> None:
    """Follow the paths from above row by row, and write their means."""
    for y in range(first, end):
        costs, means = bench.costs[y % bench.costs.shape[0]], bench.means[y % ROWS]
        here, before = grey[y, band.start : band.end], grey[max(y - 1, 0), band.start : band.end]
        advance(costs, here, before, paths, bench.above, means, bench.across.means, DOWN)


@njit(cache=True, nogil=True)
def _sweep_up(
    grey: NDArray[np.uint8],
    paths: Paths,
    band: Band,
    bottom: int,
    first: int,
    end: int,
    place: int,
    bench: Bench,
    best: Best,
    minima: Minima,
) -> None:
    """Follow the paths from below; above ``end`` choose by the means of all paths."""
    last = grey.shape[0] - 1
    for y in range(bottom - 1, first - 1, -1):
        costs, means = bench.costs[y % bench.costs.shape[0]], bench.means[y % ROWS]
        before = grey[min(y + 1, last), band.start : band.end]
        stage = UP if y < end else ASIDE
        here = grey[y, band.start : band.end]
        if stage == UP:
            follow_row(costs, here, paths, bench.across)
        advance(costs, here, before, paths, bench.under, means, bench.across.means, stage)
        if stage == UP:
            choose_row(means, paths.minimum, y, place + y - first, band, best, minima)
