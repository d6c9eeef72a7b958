"""What a network adds to matching costs: how unlike the learned features of two pixels are."""

from __future__ import annotations

from typing import Final, NamedTuple

import numpy as np

from recon.core.kernels.compiled import Int32, UInt8, kernel
from recon.stereo.kernels.convolution import UNIT
from recon.stereo.kernels.simd.vectors import (
    SUMS,
    WIDE,
    add_shifted,
    load_row,
    no_sums,
    store_sums,
)

TILE: Final = 64  # columns that are done at a time


class Blend(NamedTuple):
    """How learned costs are added to those that are there."""

    learned: float  # cost of features that are orthogonal
    largest: float  # largest learned cost
    top: float  # largest sum


@kernel
def add_dissimilarity(
    left: Int32,
    right: Int32,
    width: int,
    minimum: int,
    blend: Blend,
    first: int,
    end: int,
    costs: UInt8,
) -> None:
    """Add to the costs of rows ``first`` to ``end - 1`` one minus the product of the features.

    ``left`` and ``right`` are int32 (N, C / 2, at least W), pairs of int16, of length `UNIT`, in
    the left and the right view; ``costs`` is uint8 (N, P, at least W). Beyond the right image its
    border pixel is repeated, as it is in the windows.
    """
    pairs, ndisp = left.shape[1], costs.shape[1]
    sums = np.empty((SUMS, TILE), np.int32)
    before = np.int64(max(minimum + ndisp + SUMS, 1))
    after = np.int64(max(-minimum, 0)) + TILE
    ours = np.zeros((pairs, width + TILE), np.int32)
    others = np.empty((pairs, before + width + after), np.int32)
    learned, largest = np.float32(blend.learned), np.float32(blend.largest)
    fall, half, top = np.float32(-learned / UNIT**2), np.float32(0.5), np.float32(blend.top)
    for y in range(first, end):
        ours[:, :width] = left[y, :, :width]
        for c in range(pairs):
            others[c, :before] = right[y, c, 0]
            others[c, before : before + width] = right[y, c, :width]
            others[c, before + width :] = right[y, c, width - 1]
        for start in range(0, width, TILE):
            last = min(TILE, width - start)
            for k in range(0, ndisp, SUMS):
                for x in range(start, start + last, WIDE):
                    products, place = no_sums(), before + x - minimum - k
                    for c in range(pairs):
                        products = add_shifted(products, load_row(ours, c, x), others, c, place)
                    store_sums(sums, 0, x - start, products)
                for i in range(min(SUMS, ndisp - k)):
                    row, products_of = costs[y, k + i, start : start + last], sums[i]
                    for x in range(last):
                        unlike = min(learned + fall * np.float32(products_of[x]), largest)
                        row[x] = np.uint8(min(np.float32(row[x]) + unlike + half, top))
