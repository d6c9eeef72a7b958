"""Large images in overlapping tiles, so that a network's memory does not grow with them."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from typing import Final

import numpy as np

from recon.core.values.arrays import Float32, UInt8

#: Pixels around a tile that a network sees with it. Beyond, nothing should decide a disparity.
_CONTEXT_PX: Final = 96


def match_in_tiles(
    match: Callable[[UInt8, UInt8], Float32],
    views: tuple[UInt8, UInt8],
    reach_px: int,
    most_px: int,
    multiple_px: int,
) -> Float32:
    """Return the disparity of two images, float32 (H, W), matched in tiles if they are large.

    Tiles begin at multiples of ``multiple_px``, so that a network which halves its images sees the
    same pixels together as in the whole image, and are cut where they meet, not blended: a mean of
    two depths is neither.

    Args:
        match: Gives the disparity of two images of one size.
        views: uint8 (H, W) or (H, W, 3), with H and W multiples of ``multiple_px``.
        reach_px: Largest disparity, which each tile sees to its left.
        most_px: Pixels of a tile with what is around it, unless that alone is more.
        multiple_px: Of the network's sizes.
    """
    height, width = views[0].shape[:2]
    if height * width <= most_px:
        return match(*views)

    def even(length: float) -> int:
        return multiple_px * -(-int(length) // multiple_px)

    around = even(_CONTEXT_PX)
    before = around + even(reach_px)
    # As wide as possible: disparities reach along rows.
    wide = min(width, max(even(most_px / (4 * around)), before + 2 * around))
    tall = min(height, max(even(most_px / wide - multiple_px + 1), 3 * around))
    values = np.empty((height, width), np.float32)
    for top, rows in _spans(height, tall, around, around):
        for left, columns in _spans(width, wide, before, around):
            ends = rows.stop + around, columns.stop + around
            seen = np.s_[top : ends[0], left : ends[1]]
            found = match(views[0][seen], views[1][seen])
            kept = np.s_[rows.start - top : rows.stop - top, columns.start - left :]
            values[rows, columns] = found[kept][:, : columns.stop - columns.start]
    return values


def _spans(length: int, most: int, before: int, after: int) -> Iterator[tuple[int, slice]]:
    """Yield where each tile begins to see, and what of its result is kept."""
    first = 0
    while first < length:
        start = max(first - before, 0)
        last = length if start + most >= length else start + most - after
        yield start, slice(first, last)
        first = last
