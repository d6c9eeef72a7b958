"""Reduces points, triangles and cells for display, evenly and deterministically."""

from __future__ import annotations

import math
from typing import Any

import numpy as np
from numpy.typing import NDArray

from recon.core.values import OccupancyGrid, PointCloud, TriangleMesh
from recon.core.values.arrays import UInt8


def thin_cloud(cloud: PointCloud, limit: int) -> PointCloud:
    """At most ``limit`` points, evenly spread: the first one of each cell of a coarse grid."""
    return cloud.select(_even_subset(cloud.xyz, limit))


def thin_mesh(mesh: TriangleMesh, limit: int) -> TriangleMesh:
    """At most about ``limit`` triangles, by merging vertices that share a cell.

    Degenerate triangles are removed. For display, not for measurement.
    """
    size = 0.0
    thinned = mesh
    while len(thinned.faces) > limit:
        # The number of triangles falls with the square of the cell size.
        grown = size * math.sqrt(len(thinned.faces) / limit) * 1.05
        size = max(grown, _typical_edge(mesh))
        thinned = _merge_vertices(mesh, size)
    return thinned


def thin_grid(grid: OccupancyGrid, limit: int) -> OccupancyGrid:
    """A grid of larger cells, at most ``limit`` per side, for pictures of large maps.

    A larger cell is occupied if any of its cells is, else free if any is, so that no obstacle is
    lost.
    """
    factor = math.ceil(max(grid.cells.shape) / limit)
    if factor <= 1:
        return grid
    rows, columns = (np.arange(0, size, factor) for size in grid.cells.shape)
    # Unknown is -1, free 0 and occupied larger, so the maximum is kept.
    cells = np.maximum.reduceat(np.maximum.reduceat(grid.cells, rows, axis=0), columns, axis=1)
    return OccupancyGrid(cells, grid.resolution_m * factor, grid.origin_m)


def quantise_colours(rgb: UInt8, depth: int = 8) -> tuple[UInt8, UInt8]:
    """Reduce colours to a palette by median cut (Heckbert 1982).

    Args:
        rgb: uint8 (N, 3).
        depth: Number of successive halvings; at most 8.

    Returns:
        The palette, uint8 (P, 3) with 1 <= P <= 2**depth, and uint8 (N,) indices into it.
    """
    index = np.zeros(len(rgb), dtype=np.uint8)
    boxes = _median_cut(rgb, np.arange(len(rgb)), depth)
    palette = np.zeros((max(len(boxes), 1), 3), dtype=np.uint8)
    for number, members in enumerate(boxes):
        palette[number] = np.rint(rgb[members].mean(axis=0))
        index[members] = number
    return palette, index


def _median_cut(rgb: UInt8, members: NDArray[np.intp], depth: int) -> list[NDArray[np.intp]]:
    """Split a box of colours at the median of its longest side, ``depth`` times."""
    if not len(members):
        return []
    sides = np.ptp(rgb[members], axis=0)
    if depth == 0 or not sides.any():
        return [members]
    axis = int(np.argmax(sides))
    values = rgb[members, axis]
    upper = values > np.median(values)
    if not upper.any():  # at least half have the largest value: these form the upper part
        upper = values == values.max()
    lower_boxes = _median_cut(rgb, members[~upper], depth - 1)
    return lower_boxes + _median_cut(rgb, members[upper], depth - 1)


def _even_subset(xyz: NDArray[Any], limit: int) -> NDArray[np.intp]:
    kept = np.arange(len(xyz))
    size = _first_cell(xyz, limit)
    while len(kept) > limit:
        kept = np.sort(np.unique(_cell_numbers(xyz, size), return_index=True)[1])
        size *= max(math.sqrt(len(kept) / limit), 1.02)
    return kept


def _first_cell(xyz: NDArray[Any], limit: int) -> float:
    """An initial cell size, with more than ``limit`` cells on a face of the bounding cube."""
    if not len(xyz):
        return 1.0
    longest = float(np.ptp(xyz, axis=0).max())
    return max(longest / (4.0 * math.sqrt(limit)), 1e-6)


def _cell_numbers(xyz: NDArray[Any], size: float) -> NDArray[np.int64]:
    """int64 (N,): the number of the cell of each point."""
    keys = np.floor((xyz - xyz.min(axis=0)) / size).astype(np.int64)
    extent = keys.max(axis=0) + 1
    return np.asarray((keys[:, 0] * extent[1] + keys[:, 1]) * extent[2] + keys[:, 2])


def _merge_vertices(mesh: TriangleMesh, size: float) -> TriangleMesh:
    _, first, cell = np.unique(
        _cell_numbers(mesh.vertices, size), return_index=True, return_inverse=True
    )
    faces = cell.reshape(-1)[mesh.faces].astype(np.int32)
    a, b, c = faces.T
    kept = (a != b) & (b != c) & (c != a)
    return TriangleMesh(
        vertices=mesh.vertices[first],
        faces=faces[kept],
        rgb=None if mesh.rgb is None else mesh.rgb[first],
    )


def _typical_edge(mesh: TriangleMesh) -> float:
    corners = mesh.vertices[mesh.faces[:, :2]]
    lengths = np.linalg.norm(corners[:, 0] - corners[:, 1], axis=1)
    # At most 1e5 cells per side, so that cell numbers fit in an int64.
    return max(float(np.median(lengths)), float(np.ptp(mesh.vertices, axis=0).max()) * 1e-5, 1e-6)
