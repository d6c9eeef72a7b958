"""The signed distance to the surface that points with normals lie on, and its triangles.

At the corners of a grid, the distance is the weighted mean of those to the planes through the
points in reach, each across its own normal. A corner is known where points lie around its foot on
the surface, and not on one side of it alone: holes narrower than the reach close, and borders do
not grow. Where the sign changes along an edge of the grid, the surface crosses it; every cell gets
a vertex for each sheet of surface in it, so that sheets that share a cell stay apart. The reference
implementation is in `tests/map/kernels/reference.py`.

Ref: R. Kolluri, "Provably good moving least squares", SODA 2005 (the distance); A. Adamson and
M. Alexa, "Approximating bounded, nonorientable surfaces from points", SMI 2004 (the border);
G. Nielson, "Dual marching cubes", IEEE Visualization 2004 (a vertex for each sheet).
"""

from __future__ import annotations

import math
from functools import cache
from itertools import product
from typing import Final, NamedTuple

import numpy as np

from recon.core.kernels import voxels
from recon.core.kernels.compiled import Float32, Float64, Int32, Int64, UInt8, kernel
from recon.core.kernels.voxels import (
    EMPTY,
    Arrays,
    find,
    find_or_append,
    pack_key,
    reserve,
    unpack_key,
)

REACH: Final = 2.5
"""How far along the surface a point counts, in cells: holes twice as wide can close."""
THICKNESS: Final = 2.0
"""How far from the plane of a point corners are known: more than the diagonal of a cell, as the
surface is the mean of several planes."""
_CORNERS: Final = np.array(list(product((0, 1), repeat=3)))  # (8, 3), of a cell
_EDGES: Final = np.array(
    [
        (corner, corner + (4 >> axis))
        for axis in range(3)
        for corner in range(8)
        if not corner & (4 >> axis)
    ]
)
"""(12, 2), corners of the edges of a cell: four along each axis."""
_EDGE_AT: Final = np.full((3, 8), EMPTY)
_EDGE_AT[np.repeat(range(3), 4), _EDGES[:, 0]] = range(12)
"""(3, 8), the edge along an axis that begins at a corner."""
_AROUND: Final = np.array([(0, 0), (1, 0), (1, 1), (0, 1)])
"""Steps back, along the two other axes, to the cells around an edge: counterclockwise about it."""
Grid = tuple[Int64, Int64, Float32]
"""Hash from packed corner to row, packed corners (C,), distance at each (C,) or NaN."""
Sheets = tuple[UInt8, Int32, Int32]
"""Pattern of each cell (C,), by its first corner; its first vertex (C,); what `_sheets` returns."""


class Corners(NamedTuple):
    """Corners of the grid, one row each."""

    table: Int64  # hash from packed corner to row
    keys: Int64  # (C,), packed corners
    # (C, 5), sum of weights; weighted sums of the distance, and of the way along the surface from
    # the foot of the corner to the points (x, y, z)
    sums: Float32
    used: Int64  # (1,), number of rows in use


def make_corners(rows: int) -> Corners:
    """Return ``rows`` empty rows."""
    return Corners(
        table=voxels.make_table(rows),
        keys=np.zeros(rows, np.int64),
        sums=np.zeros((rows, 5), np.float32),
        used=np.zeros(1, np.int64),
    )


def surface_of(xyz: Float64, normals: Float32, farthest: float) -> tuple[Float64, Int32]:
    """Return vertices (V, 3) and triangles int32 (F, 3) of the surface through points.

    No edge has more than two triangles; those of a piece of surface are oriented alike.

    Args:
        xyz: float64 (N, 3), points; the unit is the edge of a cell.
        normals: float32 (N, 3), unit length, to the side that is free: triangles face it.
        farthest: How far the middle of the points around a corner may be from its foot; infinity =
            as far as points reach.
    """
    corners, done = make_corners(_MOST), 0
    while (done := _add_planes(tuple(corners), xyz, normals, done)) < len(xyz):
        corners = reserve(corners, len(corners.keys) + _MOST, make_corners)
    used = int(corners.used[0])
    weights, sums = corners.sums[:used, 0], corners.sums[:used, 1:]
    known = np.linalg.norm(sums[:, 1:], axis=1) <= np.float32(farthest) * weights
    distance = np.where(known, sums[:, 0] / weights, np.float32(np.nan))
    grid, sheets = (corners.table, corners.keys[:used], distance), _sheets()
    patterns = np.zeros(used, np.uint8)
    _find_patterns(grid, patterns)
    number = (sheets.max(axis=1) + 1)[patterns]
    in_cells = patterns, (np.cumsum(number) - number).astype(np.int32), sheets
    vertices = np.zeros((int(number.sum()), 3))
    _place_vertices(grid, in_cells, vertices)
    quads = np.zeros((3 * used, 4), np.int32)
    quads = quads[: _find_quads(grid, in_cells, quads)]
    return vertices, _manifold(_triangles(vertices, quads))


@cache
def _sheets() -> Int32:
    """Return int32 (256, 12): the sheet of surface on each edge of a cell, -1 where there is none.

    Bit ``c`` of a pattern is whether corner ``c`` is above the surface.
    """
    bits = np.arange(256)[:, None] >> np.arange(8) & 1
    return np.array([_sheets_of(above) for above in bits], np.int32)


def _sheets_of(above: Int64) -> list[int]:
    """Return the sheet on each edge of a cell; ``above`` (8,) are its corners.

    On a face with four crossed edges the corners above are kept apart, in both of its cells.
    """
    crossed = above[_EDGES[:, 0]] != above[_EDGES[:, 1]]
    label = np.where(crossed, np.arange(12), -1)
    for axis, side in product(range(3), (0, 1)):
        on_face = (_CORNERS[_EDGES][:, :, axis] == side).all(axis=1)
        pairs = [np.flatnonzero(crossed & on_face)]
        if len(pairs[0]) == 4:
            ends = [(_EDGES - corner == 0).any(axis=1) for corner in range(8) if above[corner]]
            pairs = [np.flatnonzero(crossed & on_face & at) for at in ends]
        for one, other in (pair for pair in pairs if len(pair)):
            label[label == label[other]] = label[one]
    names = sorted({*label[crossed].tolist()})
    return [names.index(at) if at >= 0 else -1 for at in label.tolist()]


def _triangles(vertices: Float64, quads: Int32) -> Int32:
    """Split quads (Q, 4) along their shorter diagonals."""
    a, b, c, d = vertices[quads].transpose(1, 0, 2)
    turned = np.linalg.norm(a - c, axis=1) > np.linalg.norm(b - d, axis=1)
    quads = np.where(turned[:, None], np.roll(quads, -1, axis=1), quads)
    return np.concatenate([quads[:, [0, 1, 2]], quads[:, [0, 2, 3]]])


def _manifold(faces: Int32) -> Int32:
    """Return the triangles (F, 3) without those at an edge that two pass in the same direction.

    That is where one sheet passes both of the cells at a face of the grid twice.
    """
    begin, end = faces.astype(np.int64), np.roll(faces, -1, axis=1)
    edges, opposite = (begin << 32) | end, (end.astype(np.int64) << 32) | begin
    ordered = np.sort(edges, axis=None)
    crowded = ordered[1:][ordered[1:] == ordered[:-1]]
    if not len(crowded):
        return faces
    return faces[~(np.isin(edges, crowded) | np.isin(opposite, crowded)).any(axis=1)]


_MOST: Final = math.ceil(2 * math.hypot(REACH, THICKNESS) + 1) ** 3  # corners in reach of a point


@kernel
def _add_planes(corners: Arrays, xyz: Float64, normals: Float32, start: int) -> int:
    """Add the planes of points from ``start`` on; return the first that finds no memory left."""
    table, keys, sums, used = corners
    for n in range(start, len(xyz)):
        if used[0] + _MOST > len(keys):
            return n
        x, y, z = xyz[n]
        u, v, w = normals[n]
        a = REACH * math.sqrt(max(0.0, 1 - u * u)) + THICKNESS * abs(u)
        b = REACH * math.sqrt(max(0.0, 1 - v * v)) + THICKNESS * abs(v)
        c = REACH * math.sqrt(max(0.0, 1 - w * w)) + THICKNESS * abs(w)
        for i in range(math.ceil(x - a), math.floor(x + a) + 1):
            for j in range(math.ceil(y - b), math.floor(y + b) + 1):
                for k in range(math.ceil(z - c), math.floor(z + c) + 1):
                    p, q, r = i - x, j - y, k - z
                    along = u * p + v * q + w * r
                    across2 = p * p + q * q + r * r - along * along
                    if abs(along) > THICKNESS or across2 > REACH * REACH:
                        continue
                    row = find_or_append(table, keys, used, pack_key(i, j, k))
                    # Half as wide along the normal: of a thin wall, the near side counts.
                    weight = math.exp(-0.5 * (across2 + 4 * along * along))
                    sums[row, 0] += weight
                    sums[row, 1] += weight * along
                    sums[row, 2] += weight * (along * u - p)
                    sums[row, 3] += weight * (along * v - q)
                    sums[row, 4] += weight * (along * w - r)
    return len(xyz)


@kernel
def _row_at(grid: Grid, row: int, step: Int64, sign: int) -> int:
    """Return the row of the corner a step (3,) away from that of a row, or `EMPTY`."""
    i, j, k = unpack_key(grid[1][row])
    key = pack_key(i + sign * step[0], j + sign * step[1], k + sign * step[2])
    return int(find(grid[0], key))


@kernel
def _find_patterns(grid: Grid, patterns: UInt8) -> None:
    """Write which corners of each cell are above; 0, as below, where one of them is not known."""
    distance = grid[2]
    for n in range(len(distance)):
        pattern = 0
        for c in range(8):
            row = _row_at(grid, n, _CORNERS[c], 1)
            if row == EMPTY or math.isnan(distance[row]):
                pattern = 0
                break
            pattern |= (distance[row] >= 0) << c
        patterns[n] = pattern


@kernel
def _place_vertices(grid: Grid, in_cells: Sheets, vertices: Float64) -> None:
    """Write the vertex of each sheet: the mean of where it crosses the edges of its cell."""
    patterns, first, sheets = in_cells
    distance, number = grid[2], np.zeros(len(vertices))
    for n in range(len(patterns)):
        for e in range(12):
            sheet = sheets[patterns[n], e]
            if sheet < 0:
                continue
            begin, end = _CORNERS[_EDGES[e, 0]], _CORNERS[_EDGES[e, 1]]
            d, f = distance[_row_at(grid, n, begin, 1)], distance[_row_at(grid, n, end, 1)]
            vertex, ratio = first[n] + sheet, d / (d - f)
            number[vertex] += 1
            cell = unpack_key(grid[1][n])
            for axis in range(3):
                place = cell[axis] + begin[axis] + ratio * (end[axis] - begin[axis])
                vertices[vertex, axis] += (place - vertices[vertex, axis]) / number[vertex]


@kernel
def _find_quads(grid: Grid, in_cells: Sheets, quads: Int32) -> int:
    """Write a quad, facing up, around each crossed edge whose cells are known; return how many."""
    patterns, first, sheets = in_cells
    distance, found, step = grid[2], 0, np.zeros(3, np.int64)
    for n in range(len(distance)):
        for axis in range(3):
            step[:] = 0
            step[axis] = 1
            row = _row_at(grid, n, step, 1)
            if row == EMPTY or math.isnan(distance[n]) or math.isnan(distance[row]):
                continue
            above = distance[n] >= 0
            if above == (distance[row] >= 0):
                continue
            corners = 0
            for m in range(4):
                step[:] = 0
                step[(axis + 1) % 3], step[(axis + 2) % 3] = _AROUND[m]
                cell = _row_at(grid, n, step, -1)
                edge = _EDGE_AT[axis, 4 * step[0] + 2 * step[1] + step[2]]
                if cell == EMPTY or sheets[patterns[cell], edge] < 0:
                    break
                quads[found, 3 - m if above else m] = first[cell] + sheets[patterns[cell], edge]
                corners += 1
            found += corners == 4
    return found
