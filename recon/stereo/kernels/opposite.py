"""Averages over pairs of opposite neighbours, which keep slopes and steps.

The reference implementation is in `tests/stereo/kernels/opposite_reference.py`.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from recon.core.kernels.compiled import kernel


@kernel
def average_opposite(
    values: NDArray[np.float32],
    radius: int,
    largest_step: float,
    first: int,
    end: int,
    averages: NDArray[np.float32],
) -> None:
    """Average each pixel of some rows with the pairs of opposite neighbours that are near it.

    A pair is a neighbour and its mirror image about the pixel; it counts where both are within
    the image, have a value, and differ from the pixel's by ``largest_step`` or less. On a plane
    the mean of a pair is the pixel's own value, so slopes are preserved even beside holes and
    steps, where a mean over all neighbours would be biased. Only the fields of a chessboard that
    have the pixel's colour are used: the noise of neighbours is correlated, so the others would
    add little for twice the time.

    Args:
        values: float32 (H, W); NaN = none.
        radius: Half width of the square that neighbours come from.
        largest_step: In the unit of ``values``.
        first: First row to average.
        end: Row after the last one.
        averages: float32 (H, W), another array, whose rows ``first`` to ``end`` are written; NaN
            where the pixel has no value.
    """
    height, width = values.shape
    step = np.float32(largest_step)
    count = np.empty(width, np.float32)
    for y in range(first, end):
        row, total = values[y], averages[y]
        total[:] = row
        count[:] = np.float32(1)
        for dy in range(min(radius, y, height - 1 - y) + 1):
            before, after = values[y - dy], values[y + dy]
            for dx in range((dy - radius) % 2 - radius if dy else 2, radius + 1, 2):
                # The pixels whose two neighbours lie within the row.
                start, stop = min(abs(dx), width), max(width - abs(dx), 0)
                _add_pair(
                    before[start - dx :], after[start + dx :], row[start:stop], step,
                    total[start:stop], count[start:stop],
                )  # fmt: skip
        for x in range(width):
            total[x] /= count[x]


@kernel
def _add_pair(
    one: NDArray[np.float32],
    other: NDArray[np.float32],
    row: NDArray[np.float32],
    step: np.float32,
    total: NDArray[np.float32],
    count: NDArray[np.float32],
) -> None:
    """Add one pair of neighbours of each pixel of a row. No comparison with NaN is true."""
    zero, two = np.float32(0), np.float32(2)
    for x in range(row.size):
        a, b, centre = one[x], other[x], row[x]
        near = (abs(a - centre) <= step) & (abs(b - centre) <= step)
        total[x] += a + b if near else zero
        count[x] += two if near else zero
