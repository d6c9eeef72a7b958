"""`recon.stereo.kernels.finish` in plain Python: the definition of its results."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray


def find_speckles_reference(
    values: NDArray[np.float32], largest_step: float, smallest_size: int
) -> NDArray[np.bool_]:
    """As `recon.stereo.kernels.finish.find_speckles`, by flooding one region after the other."""
    small = np.zeros(values.shape, np.bool_)
    todo = np.isfinite(values)
    while todo.any():
        seed = np.unravel_index(int(np.argmax(todo)), values.shape)
        region = _flood(values, (int(seed[0]), int(seed[1])), largest_step)
        todo &= ~region
        if region.sum() < smallest_size:
            small |= region
    return small


def _flood(
    values: NDArray[np.float32], seed: tuple[int, int], largest_step: float
) -> NDArray[np.bool_]:
    region = np.zeros(values.shape, np.bool_)
    region[seed] = True
    waiting = [seed]
    while waiting:
        y, x = waiting.pop()
        for v, u in ((y - 1, x), (y + 1, x), (y, x - 1), (y, x + 1)):
            inside = 0 <= v < values.shape[0] and 0 <= u < values.shape[1]
            if inside and not region[v, u] and abs(values[v, u] - values[y, x]) <= largest_step:
                region[v, u] = True
                waiting.append((v, u))
    return region
