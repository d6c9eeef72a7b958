"""True obstacles of a street: surfaces within a band of heights above the road."""

from __future__ import annotations

from typing import Final

import numpy as np
from numpy.typing import NDArray

from recon.core.geometry import se3
from recon.core.raycasting import RayScene
from recon.core.values import FREE, OCCUPIED, OccupancyGrid
from recon.core.values.arrays import Bool, Float64
from recon.street.street import StreetWorld

_SLICE_M: Final = 0.05


def footprint(
    world: StreetWorld,
    T_map_street: Float64,
    band_m: tuple[float, float],
    raster: tuple[NDArray[np.int64], tuple[int, int], float],
) -> OccupancyGrid:
    """Return OCCUPIED where a surface lies in the height band, else FREE.

    Objects taller than the band, such as houses, are hollow.

    Args:
        world: The street.
        T_map_street: float64 (4, 4), the map axes to use.
        band_m: Heights above the road.
        raster: Smallest column and row (in cells from the map origin), rows and columns, cell
            size in metres.
    """
    low, (rows, columns), resolution_m = raster
    origin = (float(low[0] * resolution_m), float(low[1] * resolution_m))
    vertices = se3.apply(T_map_street, world.soup.vertices.reshape(-1, 3)).reshape(-1, 3, 3)
    ends = vertices[..., :2].min(axis=1), vertices[..., :2].max(axis=1)
    far_end = np.array([low[0] + columns, low[1] + rows]) * resolution_m
    near = ((ends[1] >= origin) & (ends[0] <= far_end)).all(axis=1)
    outlines = _outlines(world.soup.vertices[near], band_m, resolution_m / 4.0)
    outlines = se3.apply(T_map_street, outlines)
    cells = np.floor(outlines[:, :2] / resolution_m).astype(int) - low
    inside = ((cells >= 0) & (cells < (columns, rows))).all(axis=1)
    occupied = np.zeros((rows, columns), dtype=np.bool_)
    occupied[cells[inside, 1], cells[inside, 0]] = True
    centres = _quarter_centres((rows, columns), origin, resolution_m)
    occupied |= _covered(world, T_map_street, centres, band_m).reshape(rows, columns, 4).any(axis=2)
    values = np.where(occupied, OCCUPIED, FREE).astype(np.int8)
    return OccupancyGrid(values, resolution_m, origin)


def _outlines(vertices: Float64, band_m: tuple[float, float], step_m: float) -> Float64:
    """Points (N, 3) every ``step_m`` along horizontal cuts through triangles in a height band."""
    levels = np.arange(band_m[0], band_m[1] + 1e-9, _SLICE_M)
    lowest, highest = vertices[..., 2].min(axis=1), vertices[..., 2].max(axis=1)
    cuts = [
        _sample_segments(*_level_cut(vertices[(lowest < z) & (highest > z)], z), step_m)
        for z in levels
    ]
    return np.concatenate(cuts)


def _level_cut(triangles: Float64, z: float) -> tuple[Float64, Float64]:
    """Return ends (N, 3) of the segments in which triangles cross the plane at height ``z``."""
    above = triangles[..., 2] > z
    # The corner that is alone on its side of the plane; both edges from it cross the plane.
    lone = np.where(above.sum(axis=1) == 1, above.argmax(axis=1), (~above).argmax(axis=1))
    row = np.arange(len(triangles))
    apex = triangles[row, lone]
    ends = []
    for step in (1, 2):
        other = triangles[row, (lone + step) % 3]
        share = (z - apex[:, 2]) / (other[:, 2] - apex[:, 2])
        ends.append(apex + share[:, None] * (other - apex))
    return ends[0], ends[1]


def _sample_segments(start: Float64, end: Float64, step_m: float) -> Float64:
    """Return points (M, 3) on segments, at most ``step_m`` apart, including the ends."""
    pieces = np.ceil(np.linalg.norm(end - start, axis=1) / step_m).astype(int) + 1
    segment = np.repeat(np.arange(len(start)), pieces + 1)
    first = np.cumsum(pieces + 1) - (pieces + 1)
    share = (np.arange(len(segment)) - first[segment]) / pieces[segment]
    return np.asarray(start[segment] + share[:, None] * (end - start)[segment])


def _quarter_centres(
    shape: tuple[int, int], origin_m: tuple[float, float], resolution_m: float
) -> Float64:
    """Return centres (rows·columns·4, 2) of the quarters of each cell, map axes, cell by cell."""
    row, column = np.indices(shape)
    corner = np.stack([column, row], axis=-1).reshape(-1, 1, 2)
    quarters = np.array([[0.25, 0.25], [0.75, 0.25], [0.25, 0.75], [0.75, 0.75]])
    return np.asarray(((corner + quarters) * resolution_m + origin_m).reshape(-1, 2))


def _covered(
    world: StreetWorld, T_map_street: Float64, xy_map: Float64, band_m: tuple[float, float]
) -> Bool:
    """Return whether a vertical line between the two heights hits a surface, for points (N, 2)."""
    level = np.column_stack([xy_map, np.full(len(xy_map), T_map_street[2, 3])])
    feet = se3.apply(se3.invert(T_map_street), level)
    feet[:, 2] = band_m[1]
    down = np.broadcast_to([0.0, 0.0, band_m[0] - band_m[1]], feet.shape)
    return RayScene(world.soup.vertices, world.settings.threads).blocked(feet, down)
