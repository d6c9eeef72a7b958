"""Which candidates are offered to the pixels of which tile of a picture.

A search at half size costs an eighth and says which disparities there are in a part of a picture.
Only those are worth offering at full size.
"""

from __future__ import annotations

from typing import Final, NamedTuple

import numpy as np
from numba import njit
from numpy.typing import NDArray

GROUP: Final = 8
"""Candidates that are offered, or not offered, together."""

Offer = NDArray[np.bool_]
"""bool (G,), which groups of candidates are offered."""


class Tiles(NamedTuple):
    """Which candidates are offered where.

    Attributes:
        offered: bool (I, J, G), by tile and group of candidates.
        height: Rows of a tile, at least the half height of a window.
        width: Columns of a tile.
    """

    offered: NDArray[np.bool_]
    height: int
    width: int


class Support(NamedTuple):
    """What it takes for candidates to be offered.

    Attributes:
        margin_x: So far beside a tile its columns are looked at too, pixels.
        margin_y: So far above and below a tile its rows are looked at too, pixels.
        margin: A match supports the candidates that are so far from it, and nearer ones.
        matched: Least share of the pixels looked at that are to be matched; with fewer, all
            candidates are offered.
        share: Least share of those matches that support a group.
        least: Least number of matches that support a group.
    """

    margin_x: int
    margin_y: int
    margin: int
    matched: float
    share: float
    least: int


def make_tiles(shape: tuple[int, int], size: tuple[int, int], ndisp: int) -> Tiles:
    """Tiles that are offered everything.

    Args:
        shape: Rows and columns of the picture.
        size: Rows and columns of a tile.
        ndisp: Number of candidates.
    """
    across, down = -(-shape[0] // size[0]), -(-shape[1] // size[1])
    return Tiles(np.ones((across, down, -(-ndisp // GROUP)), np.bool_), *size)


@njit(cache=True, nogil=True)
def offer_supported(
    halved: NDArray[np.float32],
    minimum: int,
    ndisp: int,
    support: Support,
    first: int,
    end: int,
    tiles: Tiles,
) -> None:
    """Offer the tiles of some rows those groups of candidates that matches at half size support.

    Args:
        halved: float32 (h, w), disparities of the pictures at half size; NaN = no match.
        minimum: Disparity of candidate 0 at full size.
        ndisp: Number of candidates at full size.
        support: What it takes.
        first: First row of tiles to do.
        end: The row after the last.
        tiles: ``offered`` is written.
    """
    counts = np.empty(ndisp, np.int64)
    _, columns, groups = tiles.offered.shape
    for i in range(first, end):
        y0, y1 = _reach(i, tiles.height, support.margin_y, halved.shape[0])
        for j in range(columns):
            x0, x1 = _reach(j, tiles.width, support.margin_x, halved.shape[1])
            counts[:] = 0
            matched = _count(halved[y0:y1, x0:x1], minimum, counts)
            least = max(support.share * matched, support.least)
            everything = matched < support.matched * (y1 - y0) * (x1 - x0)
            for group in range(groups):
                first = max(group * GROUP - support.margin, 0)
                supporters = counts[first : (group + 1) * GROUP + support.margin].sum()
                tiles.offered[i, j, group] = everything or supporters >= least


@njit(cache=True, nogil=True)
def _reach(tile: int, size: int, margin: int, halved: int) -> tuple[int, int]:
    """First and end, at half size, of what is looked at for a tile, along one side."""
    start, end = tile * size - margin, (tile + 1) * size + margin
    return max(start, 0) // 2, min(end // 2, halved)


@njit(cache=True, nogil=True)
def _count(halved: NDArray[np.float32], minimum: int, counts: NDArray[np.int64]) -> int:
    """Count the matches at each candidate of full size; give their number."""
    matched = 0
    for y in range(halved.shape[0]):
        for x in range(halved.shape[1]):
            if not np.isnan(halved[y, x]):
                k = np.int64(np.rint(2 * halved[y, x])) - minimum
                counts[min(max(k, 0), counts.size - 1)] += 1
                matched += 1
    return matched
