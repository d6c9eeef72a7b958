"""Which cells the surface of the points around them crosses; all lengths are in cells.

Hits of one surface scatter over several cells along the rays, but the mean of many is precise: a
plane through the points in and around a cell, weighted by their precision, decides whether the
surface is in this cell or in the one before or behind it. The reference implementation is in
`tests/map/kernels/reference.py`.

Ref: H. Hoppe et al., "Surface reconstruction from unorganized points", SIGGRAPH 1992, section 3.2
(the tangent plane from the covariance of the neighbourhood).
"""

from __future__ import annotations

import math
from typing import Final

import numpy as np

from recon.core.kernels.compiled import Bool, Float32, Float64, Int32, Int64, kernel
from recon.core.kernels.voxels import EMPTY, enter_keys, find, make_table, pack_key

AROUND: Final = 27
LEAST: Final = 3
"""Points that a plane needs; with fewer, a cell counts as crossed if it holds one."""


def crossed_cells(cells: Int32, keys: Int64, sums: Float32) -> Bool:
    """Fit a plane to the points in and around each cell (N, 3), and test whether it crosses it.

    The normal is that of the weighted covariance of the points. The plane's distance from the
    centre of the cell is their weighted mean; points beside the normal count less, by a Gaussian of
    one cell. ``keys`` (M,) are the packed cells that hold points, each once; ``sums`` (M, 4) the
    sum of their weights, above 0, and weighted sums of the offsets from the centre of the cell.
    """
    table = make_table(len(keys))
    enter_keys(table, keys)
    spreads = np.zeros((len(cells), 3, 3))
    _measure_spreads(cells, table, sums, spreads)
    # Not in a kernel: numba takes linear algebra from scipy, which takes half a second to load.
    normals = np.ascontiguousarray(np.linalg.eigh(spreads)[1][:, :, 0])
    crossed = np.zeros(len(cells), np.bool_)
    _test_cells(cells, table, sums, normals, crossed)
    return crossed


@kernel
def _measure_spreads(cells: Int32, table: Int64, sums: Float32, spreads: Float64) -> None:
    """Write the covariance (N, 3, 3) of the points around each cell; 0 where they are too few."""
    points, weights = np.empty((AROUND, 3)), np.empty(AROUND)
    for n in range(len(cells)):
        found, _ = _gather(cells[n], table, sums, points, weights)
        if found >= LEAST:
            _add_spread(points[:found], weights[:found], spreads[n])


@kernel
def _test_cells(cells: Int32, table: Int64, sums: Float32, normals: Float64, crossed: Bool) -> None:
    """Test whether the plane with the normal (N, 3) of each cell crosses it."""
    points, weights = np.empty((AROUND, 3)), np.empty(AROUND)
    for n in range(len(cells)):
        found, own = _gather(cells[n], table, sums, points, weights)
        if found < LEAST:
            crossed[n] = own
        else:
            crossed[n] = _crosses(points[:found], weights[:found], normals[n])


@kernel
def _gather(
    cell: Int32, table: Int64, sums: Float32, points: Float64, weights: Float64
) -> tuple[int, bool]:
    """Write the points in and around a cell; their number, and whether one is in the cell."""
    i, j, k = np.int64(cell[0]), np.int64(cell[1]), np.int64(cell[2])
    found, own = 0, False
    for step in range(AROUND):
        di, dj, dk = step // 9 - 1, step // 3 % 3 - 1, step % 3 - 1
        row = find(table, pack_key(i + di, j + dj, k + dk))
        if row == EMPTY:
            continue
        own = own or (di == 0 and dj == 0 and dk == 0)
        weight = np.float64(sums[row, 0])
        weights[found] = weight
        points[found, 0] = di + sums[row, 1] / weight
        points[found, 1] = dj + sums[row, 2] / weight
        points[found, 2] = dk + sums[row, 3] / weight
        found += 1
    return found, own


@kernel
def _crosses(points: Float64, weights: Float64, normal: Float64) -> bool:
    """Whether the plane through points around a cell's centre crosses the cell."""
    total, distance = 0.0, 0.0
    for n in range(len(points)):
        x, y, z = points[n, 0], points[n, 1], points[n, 2]
        along = x * normal[0] + y * normal[1] + z * normal[2]
        weight = weights[n] * math.exp(along * along - x * x - y * y - z * z)
        total += weight
        distance += weight * along
    reach = 0.5 * (abs(normal[0]) + abs(normal[1]) + abs(normal[2]))
    return bool(abs(distance) <= reach * total)


@kernel
def _add_spread(points: Float64, weights: Float64, spread: Float64) -> None:
    """Add up the covariance of weighted points."""
    total = weights.sum()
    mean = np.zeros(3)
    for n in range(len(points)):
        for a in range(3):
            mean[a] += weights[n] / total * points[n, a]
    for n in range(len(points)):
        for a in range(3):
            for b in range(3):
                product = (points[n, a] - mean[a]) * (points[n, b] - mean[b])
                spread[a, b] += weights[n] / total * product
