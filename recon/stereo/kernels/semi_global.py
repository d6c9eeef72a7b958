"""Semi-global matching: costs are aggregated along eight paths to each pixel.

A sweep down and a sweep up follow three paths each; the sweep up also follows the two horizontal
ones. Path costs are kept in uint8: their lowest is subtracted at every step, so that none exceeds
the cost of a pixel plus P2.

Memory, not arithmetic, would be the bottleneck, so what passes from one sweep to the other must
stay in the cache. A strip of rows is divided into bands of columns, and a band into blocks of rows.
The sweep down goes on from block to block; the sweep up starts afresh some rows below each block,
and a band is wider than the part of it that is kept. After this overlap a path hardly depends on
where it started.

Ref: H. Hirschmüller, "Stereo processing by semiglobal matching and mutual information", PAMI 30,
2008, equations 13 and 14.
"""

from __future__ import annotations

from typing import Final, NamedTuple

import numpy as np

from recon.core.kernels.compiled import UInt8, kernel
from recon.stereo.kernels.minima import Minima
from recon.stereo.kernels.path_costs import WriteCosts, aligned, padded
from recon.stereo.kernels.paths import (
    DOWN,
    UP,
    WARM_UP,
    PathRow,
    Paths,
    RowScratch,
    advance,
    begin,
    empty_row_scratch,
    follow_row,
)
from recon.stereo.kernels.plane_minima import MARGIN, NONE, Band, Best, choose_row, empty_best
from recon.stereo.kernels.simd.vectors import LANES

ROWS: Final = 32  # rows of a block: many, compared with the overlap below it that is swept in vain
SCRATCH_BYTES: Final = 4 << 20  # at most, for what passes between sweeps and stays in the cache


class Scratch(NamedTuple):
    """Scratch memory for a strip; its content does not matter."""

    memory: UInt8  # (N,), enough for a band
    columns: int  # columns of a band; the last one may have fewer


class BandScratch(NamedTuple):
    """Scratch memory for a band of C columns, all uint8."""

    costs: UInt8  # (ROWS + overlap, P, C), cost of each candidate at each pixel
    #: (ROWS, P, MARGIN + C + MARGIN), means of the path costs of the sweep down; the margins are
    #: `NONE`.
    means: UInt8
    above: PathRow  # paths from above
    under: PathRow  # paths from below
    along: RowScratch  # horizontal paths


def empty_scratch(width: int, paths: Paths) -> Scratch:
    """Return memory for strips of images of a width."""
    columns = band_columns(width, paths)
    return Scratch(aligned((scratch_bytes(columns, paths),)), columns)


def band_columns(width: int, paths: Paths) -> int:
    """Return columns of the bands of an image."""
    most = SCRATCH_BYTES // (paths.ndisp * (2 * ROWS + paths.overlap)) // LANES * LANES
    # A band should keep more columns than it shares with its neighbours.
    least = padded(4 * paths.side_overlap + 1)
    return min(padded(width), max(most, least))


def scratch_bytes(columns: int, paths: Paths) -> int:
    """Return memory that a band of so many columns takes."""
    return sum(int(np.prod(shape)) for shape in _shapes(columns, paths))


def _shapes(columns: int, paths: Paths) -> list[tuple[int, ...]]:
    """Return shapes of the arrays of a `BandScratch` that share the memory of a `Scratch`."""
    wide = MARGIN + columns + MARGIN
    row = [(3, paths.ndisp + 2, wide), (2, 3, wide), (3, columns), (3, columns)]
    costs, means = (ROWS + paths.overlap, paths.ndisp, columns), (ROWS, paths.ndisp, wide)
    return [costs, means, *row, *row]


def _band_scratch(scratch: Scratch, columns: int, paths: Paths) -> BandScratch:
    arrays, start = [], 0
    for shape in _shapes(columns, paths):
        size = int(np.prod(shape))
        arrays.append(scratch.memory[start : start + size].reshape(shape))
        start += size
    costs, means = arrays[:2]
    means[..., :MARGIN] = means[..., -MARGIN:] = NONE
    return BandScratch(
        costs, means, PathRow(*arrays[2:6]), PathRow(*arrays[6:]), empty_row_scratch(columns, paths)
    )


def semi_global_minima(
    grey: UInt8,
    write: WriteCosts,
    radius: int,
    paths: Paths,
    strip: range,
    scratch: Scratch,
    minima: Minima,
) -> None:
    """Find the best candidate of each pixel of a strip of rows, in the left and the right view.

    Candidate ``k`` of a pixel is the disparity ``minimum + k``. Its cost is the mean of the costs
    of the paths that end there. A path starts at the border of the image or, if that is nearer,
    ``overlap`` rows above the strip (from above), ``overlap`` rows below each block (from below) or
    ``side_overlap`` columns beside each band (from the sides). ``radius`` is the half width of
    what ``write`` reads around a pixel.
    """
    width = grey.shape[1]
    best = empty_best(scratch.columns, width, len(strip))
    minima.right_winner[strip.start : strip.stop] = paths.ndisp
    buffers = None
    for band in bands_of(width, scratch.columns, radius, paths):
        if buffers is None or padded(band.end - band.start) != buffers.costs.shape[2]:
            buffers = _band_scratch(scratch, padded(band.end - band.start), paths)
        _search_band(grey, write, paths, strip, band, buffers, best, minima)


def bands_of(width: int, columns: int, radius: int, paths: Paths) -> list[Band]:
    """Divide an image into bands that overlap, each of at most so many columns."""
    if columns < width:
        # Together with the sides of its windows, a band fills whole vectors.
        columns -= 2 * radius
    return divided(width, columns, paths.side_overlap)


def divided(length: int, most: int, overlap: int) -> list[Band]:
    """Divide columns (or rows) into bands of at most so many, which share twice the overlap."""
    bands, first = [], 0
    while first < length:
        start = max(first - overlap, 0)
        end = min(start + most, length)
        last = end if end == length else end - overlap
        bands.append(Band(start, end, first, last))
        first = last
    return bands


def _search_band(
    grey: UInt8,
    write: WriteCosts,
    paths: Paths,
    strip: range,
    band: Band,
    buffers: BandScratch,
    best: Best,
    minima: Minima,
) -> None:
    known = top = max(strip.start - paths.overlap, 0)
    begin(paths, buffers.above)
    for first in range(top, strip.stop, ROWS):
        end = min(first + ROWS, strip.stop)
        bottom = min(end + paths.overlap, len(grey))
        write(band[:2], known, bottom, buffers.costs)
        known = bottom
        _sweep_down(grey, paths, band, first, end, buffers)
        wanted = max(first, strip.start)
        if wanted < end:
            begin(paths, buffers.under)
            place = wanted - strip.start
            _sweep_up(grey, paths, band, bottom, wanted, end, place, buffers, best, minima)


@kernel
def _sweep_down(
    grey: UInt8, paths: Paths, band: Band, first: int, end: int, buffers: BandScratch
) -> None:
    for y in range(first, end):
        costs, means = buffers.costs[y % buffers.costs.shape[0]], buffers.means[y % ROWS]
        here, before = grey[y, band.start : band.end], grey[max(y - 1, 0), band.start : band.end]
        advance(costs, here, before, paths, buffers.above, means, buffers.along.means, DOWN)


@kernel
def _sweep_up(
    grey: UInt8,
    paths: Paths,
    band: Band,
    bottom: int,
    first: int,
    end: int,
    place: int,
    buffers: BandScratch,
    best: Best,
    minima: Minima,
) -> None:
    """Follow the paths from below; from row ``end - 1`` up, choose by the means of all paths."""
    last = grey.shape[0] - 1
    for y in range(bottom - 1, first - 1, -1):
        costs, means = buffers.costs[y % buffers.costs.shape[0]], buffers.means[y % ROWS]
        before = grey[min(y + 1, last), band.start : band.end]
        stage = UP if y < end else WARM_UP
        here = grey[y, band.start : band.end]
        if stage == UP:
            follow_row(costs, here, paths, buffers.along)
        advance(costs, here, before, paths, buffers.under, means, buffers.along.means, stage)
        if stage == UP:
            choose_row(means, paths.minimum, y, place + y - first, band, best, minima)
