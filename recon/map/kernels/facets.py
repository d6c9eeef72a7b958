"""Which cells the surface of the points around them crosses.

Hits of one surface scatter over several cells along the rays, but the mean of many is precise: a
plane through the points around a cell, weighted by their precision, decides whether the surface is
in this cell or in one before or behind it. The window is as wide as the points are uncertain: its
cells are doubled until they are a standard deviation wide. The reference implementation is in
`tests/map/kernels/reference.py`.

Ref: H. Hoppe et al., "Surface reconstruction from unorganized points", SIGGRAPH 1992, section 3.2
(the tangent plane from the covariance of the neighbourhood).
"""

from __future__ import annotations

import math
from typing import Final, NamedTuple

import numpy as np

from recon.core.kernels import voxels
from recon.core.kernels.compiled import Bool, Float32, Float64, Int32, Int64, kernel
from recon.core.kernels.voxels import EMPTY, find, pack_key
from recon.map.kernels.raycast import BLOCK_BITS

LEAST: Final = 3
"""Points that a plane needs; with fewer, a cell counts as crossed if it holds one."""
DOUBLINGS: Final = BLOCK_BITS
"""How often cells are doubled at most: to blocks, so that one depends on those that touch it."""
REACH: Final = 2
"""Cells of half the edge on either side, whose points place the plane: at corners and on small
things, they tell more than those of the window."""


class _Points(NamedTuple):
    """Points summed up in cells that were doubled some times; lengths in these cells."""

    table: Int64  # hash from packed cell to row
    keys: Int64  # (M,), packed cells
    sums: Float64  # (M, 5), as `crossed_cells` has them


def crossed_cells(cells: Int32, keys: Int64, sums: Float32) -> Bool:
    """Fit a plane to the points around each cell (N, 3), and test whether it crosses it.

    The normal is that of the weighted covariance of the points in the 27 cells of the window. The
    plane's distance from the centre of the cell is the weighted mean of points in cells of half the
    edge; those beside the normal count less, by a Gaussian of one such cell. ``keys`` (M,) are the
    packed cells that hold points, each once; ``sums`` (M, 5) the sum of their weights, above 0,
    weighted sums of the offsets from the centre of the cell, in cells, and of variances, in cells².
    """
    crossed, rows = np.zeros(len(cells), np.bool_), np.arange(len(cells))
    order = np.argsort(keys)  # so that sums do not depend on what was seen first
    windows = [_points(keys[order], sums[order].astype(np.float64))]
    for doublings in range(DOUBLINGS + 1):
        homes, home = np.unique(voxels.pack_keys(cells[rows] >> doublings), return_inverse=True)
        last = doublings == DOUBLINGS
        normals, wide = _normals(voxels.unpack_keys(homes), windows[-1], last=last)
        tested = wide[home]
        finer, reach = (doublings - 1, REACH) if doublings else (0, 1)
        edge = 0.5**finer
        places = np.asarray((cells[rows[tested]] + 0.5) * edge, np.float64)
        found = np.zeros(len(places), np.bool_)
        table, _, totals = windows[finer]
        _test_cells(places, edge, reach, table, totals, normals[home[tested]], found)
        crossed[rows[tested]], rows = found, rows[~tested]
        windows.append(_doubled(windows[-1]))
    return crossed


def _points(keys: Int64, sums: Float64) -> _Points:
    table = voxels.make_table(len(keys))
    voxels.enter_keys(table, keys)
    return _Points(table, keys, sums)


def _doubled(points: _Points) -> _Points:
    """Return the points in cells of twice the edge."""
    cells = voxels.unpack_keys(points.keys)
    weights, offsets, variances = np.split(points.sums, [1, 4], axis=1)
    offsets = (offsets + weights * ((cells & 1) - 0.5)) / 2
    sums = np.concatenate([weights, offsets, variances / 4], axis=1)
    keys = voxels.pack_keys(cells >> 1)
    order = np.argsort(keys, kind="stable")
    first = np.flatnonzero(np.diff(keys[order], prepend=-1))
    return _points(keys[order][first], np.add.reduceat(sums[order], first, axis=0))


def _normals(cells: Int32, points: _Points, *, last: bool) -> tuple[Float64, Bool]:
    """Return normals (N, 3) of the points around cells that are wide enough, and which are.

    NaN where points are too few; ``last``: all are wide enough.
    """
    spreads, variances = np.zeros((len(cells), 3, 3)), np.zeros(len(cells))
    found = np.zeros(len(cells), np.int64)
    _measure_spreads(cells, points.table, points.sums, spreads, variances, found)
    # Not in a kernel: numba takes linear algebra from scipy, which takes half a second to load.
    wide = (variances <= 1.0) | last
    normals, plane = np.full((len(cells), 3), np.nan), wide & (found >= LEAST)
    normals[plane] = np.linalg.eigh(spreads[plane])[1][:, :, 0]
    return normals, wide


@kernel
def _measure_spreads(
    cells: Int32, table: Int64, sums: Float64, spreads: Float64, variances: Float64, number: Int64
) -> None:
    """Write covariance (N, 3, 3), mean variance and number of the points around each cell."""
    points, weights = np.empty((27, 3)), np.empty(27)
    for n in range(len(cells)):
        x, y, z = cells[n, 0] + 0.5, cells[n, 1] + 0.5, cells[n, 2] + 0.5
        found, variances[n] = _gather((x, y, z), 1, table, sums, points, weights)
        number[n] = found
        if found >= LEAST:
            _add_spread(points[:found], weights[:found], spreads[n])


@kernel
def _test_cells(
    places: Float64,
    edge: float,
    reach: int,
    table: Int64,
    sums: Float64,
    normals: Float64,
    crossed: Bool,
) -> None:
    """Test whether the plane with the normal (N, 3) crosses the cell of an edge at each place."""
    points, weights = np.empty((125, 3)), np.empty(125)
    for n in range(len(places)):
        place = (places[n, 0], places[n, 1], places[n, 2])
        found, _ = _gather(place, reach, table, sums, points, weights)
        if np.isnan(normals[n, 0]):
            crossed[n] = _holds(points[:found], edge)
        elif found:
            crossed[n] = _crosses(points[:found], weights[:found], normals[n], edge)


@kernel
def _gather(
    place: tuple[float, float, float],
    reach: int,
    table: Int64,
    sums: Float64,
    points: Float64,
    weights: Float64,
) -> tuple[int, float]:
    """Write the points around a place, from there; their number, and their mean variance."""
    x, y, z = place
    i, j, k = math.floor(x), math.floor(y), math.floor(z)
    found, total, variance = 0, 0.0, 0.0
    for a in range(i - reach, i + reach + 1):
        for b in range(j - reach, j + reach + 1):
            for c in range(k - reach, k + reach + 1):
                row = find(table, pack_key(a, b, c))
                if row == EMPTY:
                    continue
                weight = sums[row, 0]
                weights[found] = weight
                points[found, 0] = (a + 0.5 - x) + sums[row, 1] / weight
                points[found, 1] = (b + 0.5 - y) + sums[row, 2] / weight
                points[found, 2] = (c + 0.5 - z) + sums[row, 3] / weight
                total += weight
                variance += sums[row, 4]
                found += 1
    return found, variance / total if found else 0.0


@kernel
def _holds(points: Float64, edge: float) -> bool:
    """Whether one of the points is in the cell around which they are."""
    held = False
    for n in range(len(points)):
        held = held or np.abs(points[n]).max() <= 0.5 * edge
    return held


@kernel
def _crosses(points: Float64, weights: Float64, normal: Float64, edge: float) -> bool:
    """Whether the plane through points around a cell's centre crosses the cell."""
    total, distance = 0.0, 0.0
    for n in range(len(points)):
        x, y, z = points[n, 0], points[n, 1], points[n, 2]
        along = x * normal[0] + y * normal[1] + z * normal[2]
        weight = weights[n] * math.exp(along * along - x * x - y * y - z * z)
        total += weight
        distance += weight * along
    reach = 0.5 * edge * (abs(normal[0]) + abs(normal[1]) + abs(normal[2]))
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
