"""Which candidates are searched in which tile of an image.

A search at half size costs an eighth and shows which disparities occur in each part of an image.
"""

from __future__ import annotations

from typing import Final, NamedTuple

import numpy as np

from recon.core.kernels.compiled import Bool, Float32, Int64, kernel

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
