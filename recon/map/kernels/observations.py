"""What single frames saw of some cells: the rays that may cross them, and counts over frames.

Reference implementations: `tests/map/kernels/reference.py`.
"""

from __future__ import annotations

import math
from typing import Final

import numpy as np
from numpy.typing import NDArray

from recon.core.kernels.compiled import Bool, Float32, Float64, Int64, kernel

Int8 = NDArray[np.int8]

_BINS: Final = 128  # directions on each axis, by which rays that may matter are chosen
_WIDEST: Final = 1.5  # largest slope of a ray against the optical axis that has a bin of its own
_PER_SLOPE: Final = _BINS / (2 * _WIDEST)


@kernel
def rays_towards(xyz: Float32, cells: Float64, edge: float) -> Bool:
    """Return bool (N,), which points (N, 3) lie on rays that may cross cells.

    ``cells`` (M, 3) are the centres of cubes of an edge; all in camera axes and one unit.
    """
    # Rectangles of bins are counted at their corners, and summed up once.
    count = np.zeros((_BINS + 1, _BINS + 1), np.int64)
    for m in range(len(cells)):
        depth = max(cells[m, 2], edge)
        left, right = _bins_of(cells[m, 0] / depth, depth, edge)
        top, bottom = _bins_of(cells[m, 1] / depth, depth, edge)
        count[left, top] += 1
        count[right + 1, bottom + 1] += 1
        count[left, bottom + 1] -= 1
        count[right + 1, top] -= 1
    for i in range(_BINS):
        for j in range(_BINS):
            if i > 0:
                count[i, j] += count[i - 1, j]
            if j > 0:
                count[i, j] += count[i, j - 1]
            if i > 0 and j > 0:
                count[i, j] -= count[i - 1, j - 1]
    chosen = np.zeros(len(xyz), np.bool_)
    for n in range(len(xyz)):
        z = xyz[n, 2]
        if z > 0:
            chosen[n] = count[_bin(xyz[n, 0] / z), _bin(xyz[n, 1] / z)] > 0
    return chosen


@kernel
def _bins_of(slope: float, depth: float, edge: float) -> tuple[int, int]:
    """Return the first and the last bin of rays that may meet a cube."""
    size = (1 + abs(slope)) * edge * math.sqrt(3.0) / 2 / depth
    return _bin(slope - size), _bin(slope + size)


@kernel
def _bin(slope: float) -> int:
    """Return the bin of a slope; what is steeper shares the outermost."""
    place = (slope + _WIDEST) * _PER_SLOPE
    return math.floor(min(max(place, 0.0), _BINS - 1.0))


@kernel
def count_observation(
    look: Int8, before: Int8, cells: Int64, pairs: Int64, of_pairs: Int64
) -> None:
    """Add what one frame saw to the counts over frames, in place.

    Args:
        look: int8 (N,), 1 where it hit a cell, -1 where it looked through, 0 where it saw neither.
        before: int8 (N,), what the last frame saw that saw the cell.
        cells: int64 (3, N), frames that hit the cell, that looked through, and times that hits
            began.
        pairs: int64 (P, 2), pairs of cells.
        of_pairs: int64 (2, P), frames that saw both, and that hit one and looked through the other.
    """
    for n in range(len(look)):
        if look[n] > 0:
            cells[0, n] += 1
            cells[2, n] += before[n] <= 0
        elif look[n] < 0:
            cells[1, n] += 1
        if look[n] != 0:
            before[n] = look[n]
    for p in range(len(pairs)):
        both = look[pairs[p, 0]] * look[pairs[p, 1]]
        of_pairs[0, p] += both != 0
        of_pairs[1, p] += both < 0
