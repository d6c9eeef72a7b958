"""`recon.stereo.kernels.finish` in plain numpy: the definition of its results."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray


def average_opposite_reference(
    values: NDArray[np.float32], radius: int, largest_step: float
) -> NDArray[np.float64]:
    """As `opposite.average_opposite` of all rows, one pixel after the other."""
    averages = np.full(values.shape, np.nan)
    rows, columns = np.indices((2 * radius + 1, 2 * radius + 1))
    chessboard = (rows + columns) % 2 == 0
    for y, x in zip(*np.nonzero(np.isfinite(values)), strict=True):
        near = _square(values, int(y), int(x), radius)
        near[~(np.abs(near - values[y, x]) <= largest_step)] = np.nan
        near[~chessboard] = np.nan
        # Turned by half a turn, each neighbour lies on its opposite; the pixel on itself.
        near[np.isnan(near[::-1, ::-1])] = np.nan
        averages[y, x] = np.nanmean(near)
    return averages


def _square(values: NDArray[np.float32], y: int, x: int, radius: int) -> NDArray[np.float64]:
    """Return the square around a pixel; NaN beyond the image."""
    padded = np.pad(values.astype(float), radius, constant_values=np.nan)
    width = 2 * radius + 1
    return np.array(padded[y : y + width, x : x + width])
