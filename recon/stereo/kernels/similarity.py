"""What a network adds to matching costs: how unlike the learned features of two pixels are."""

from __future__ import annotations

from typing import Final, NamedTuple

import numpy as np

from recon.core.kernels.compiled import Float32, UInt8, kernel

TILE: Final = 64  # columns whose sums stay in registers


class Blend(NamedTuple):
    """How learned costs are added to those that are there."""

    learned: float  # cost of features that are orthogonal
    largest: float  # largest learned cost
    top: float  # largest sum


@kernel
def add_unlikeness(
    left: Float32, right: Float32, minimum: int, blend: Blend, first: int, end: int, costs: UInt8
) -> None:
    """Add to the costs of rows ``first`` to ``end - 1`` one minus the product of the features.

    ``left`` and ``right`` are float32 (N, C, W) of unit length, in the left and the right view;
    ``costs`` is uint8 (N, P, at least W). Beyond the right image its border pixel is repeated, as
    it is in the windows.
    """
    channels, width = left.shape[1:]
    ndisp, tile = costs.shape[1], np.empty(TILE, np.float32)
    before = np.int64(max(minimum + ndisp, 1))
    after = np.int64(max(-minimum, 0)) + TILE
    ours = np.zeros((channels, width + TILE), np.float32)
    others = np.empty((channels, before + width + after), np.float32)
    learned, largest = np.float32(blend.learned), np.float32(blend.largest)
    one, half, top = np.float32(1), np.float32(0.5), np.float32(blend.top)
    for y in range(first, end):
        ours[:, :width] = left[y]
        for c in range(channels):
            others[c, :before] = right[y, c, 0]
            others[c, before : before + width] = right[y, c]
            others[c, before + width :] = right[y, c, width - 1]
        for x in range(0, width, TILE):
            last = min(TILE, width - x)
            for k in range(ndisp):
                start = before + x - minimum - k
                tile[:] = np.float32(0)
                for c in range(channels):
                    here, there = ours[c, x : x + TILE], others[c, start : start + TILE]
                    for i in range(TILE):
                        tile[i] += here[i] * there[i]
                row = costs[y, k, x : x + last]
                for i in range(last):
                    unlike = min(learned * (one - tile[i]), largest)
                    row[i] = np.uint8(min(np.float32(row[i]) + unlike + half, top))
