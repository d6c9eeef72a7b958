"""The truth about a whole drive: surfaces that were in view, and where obstacles stand."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Final

import numpy as np

from recon.adapters.open3d_raycasting import RayScene
from recon.geometry import se3
from recon.structures import FREE, OCCUPIED, OccupancyGrid, PointCloud
from recon.structures.arrays import Bool, Float32, Float64, freeze
from recon.synthetic.render import StreetCamera
from recon.synthetic.street import StreetWorld

_SLICE_M: Final = 0.05
_KEY_BITS: Final = 21
_COMPACT_AT: Final = 4_000_000


@dataclass(frozen=True, eq=False)
class OccupancyTruth:
    """Where obstacles really stand, and which cells a camera could know about.

    Attributes:
        grid: OCCUPIED where an obstacle reaches into the height band, else FREE; what is taller
            than the band, such as a house, is hollow. Map axes.
        seen: bool, the shape of the grid: some pixel of the drive looked at a surface in this
            cell, at or below the top of the band.
    """

    grid: OccupancyGrid
    seen: Bool

    def __post_init__(self) -> None:
        freeze(self, "seen", np.bool_, self.grid.cells.shape)


def true_surface(
    camera: StreetCamera, *, range_m: float = 30.0, voxel_m: float = 0.05
) -> PointCloud:
    """Points on the surfaces that the left camera saw.

    Args:
        camera: The rig in its street.
        range_m: Pixels deeper than this are left out.
        voxel_m: One pixel is kept of those that fall into a voxel; it is not moved, so every
            point lies exactly on a surface.

    Returns:
        Cloud in frame ``world``.
    """
    T_street_camera = camera.world.T_street_camera
    kept = np.empty((0, 3), dtype=np.float32)
    pending: list[Float32] = []
    for index in range(len(camera)):
        T_world_camera = camera.world.T_world_street @ T_street_camera[index]
        points = _visible_points(camera, index, range_m)
        pending.append(_thin(se3.apply(T_world_camera, points).astype(np.float32), voxel_m))
        if sum(map(len, pending)) > _COMPACT_AT:
            kept, pending = _thin(np.concatenate([kept, *pending]), voxel_m), []
    return PointCloud(_thin(np.concatenate([kept, *pending]), voxel_m), frame="world")


def true_occupancy(
    world: StreetWorld,
    surface: PointCloud,
    *,
    resolution_m: float = 0.2,
    band_m: tuple[float, float] = (0.3, 2.0),
    T_map_world: Float64 | None = None,
) -> OccupancyTruth:
    """Where obstacles stand on the part of the street that was seen.

    Args:
        world: The street.
        surface: What was seen of it, as `true_surface` gives; its extent is the grid's.
        resolution_m: Edge of a cell; cell borders are at multiples of it.
        band_m: Heights above the road between which something is an obstacle. The pavement is
            0.12 m high, so a band that begins lower makes it one.
        T_map_world: The map axes to draw in; the world's own by default.
    """
    T = world.T_map_world if T_map_world is None else T_map_world
    T_map_street = T @ world.T_world_street
    in_map = se3.apply(T, surface.xyz.astype(np.float64))
    height = se3.apply(se3.invert(world.T_world_street), surface.xyz.astype(np.float64))[:, 2]
    low = np.floor(in_map[:, :2].min(axis=0) / resolution_m).astype(int)
    high = np.floor(in_map[:, :2].max(axis=0) / resolution_m).astype(int) + 1
    columns, rows = (int(n) for n in high - low)
    origin = (float(low[0] * resolution_m), float(low[1] * resolution_m))

    def mark(xy_map: Float64) -> Bool:
        cells = np.floor(xy_map / resolution_m).astype(int) - low
        inside = ((cells >= 0) & (cells < (columns, rows))).all(axis=1)
        marked = np.zeros((rows, columns), dtype=np.bool_)
        marked[cells[inside, 1], cells[inside, 0]] = True
        return marked

    outlines = _outlines(world.soup.vertices, band_m, resolution_m / 4.0)
    occupied = mark(se3.apply(T_map_street, outlines)[:, :2])
    centres = _quarter_centres((rows, columns), origin, resolution_m)
    occupied |= _covered(world, T_map_street, centres, band_m).reshape(rows, columns, 4).any(axis=2)
    cells = np.where(occupied, OCCUPIED, FREE).astype(np.int8)
    seen = mark(in_map[height <= band_m[1], :2])
    return OccupancyTruth(OccupancyGrid(cells, resolution_m, origin), seen)


def _visible_points(camera: StreetCamera, index: int, range_m: float) -> Float64:
    """Points (N, 3) of one depth map, left camera axes."""
    depth = camera.depth(index).astype(np.float64).ravel()
    rig = camera.world.camera
    near = np.flatnonzero(depth <= range_m)
    v, u = np.divmod(near, rig.width_px)
    offsets = np.stack([u - rig.cx_px, v - rig.cy_px, np.full(len(near), rig.focal_px)], axis=1)
    return np.asarray(offsets * (depth[near] / rig.focal_px)[:, None])


def _thin(xyz: Float32, voxel_m: float) -> Float32:
    """The first point in each voxel, in the order given."""
    cells = np.floor(xyz / voxel_m).astype(np.int64) + (1 << (_KEY_BITS - 1))
    keys = (cells[:, 0] << (2 * _KEY_BITS)) | (cells[:, 1] << _KEY_BITS) | cells[:, 2]
    first = np.unique(keys, return_index=True)[1]
    return np.asarray(xyz[np.sort(first)])


def _outlines(vertices: Float64, band_m: tuple[float, float], step_m: float) -> Float64:
    """Points (N, 3) every ``step_m`` along the level cuts through triangles in a height band."""
    levels = np.arange(band_m[0], band_m[1] + 1e-9, _SLICE_M)
    lowest, highest = vertices[..., 2].min(axis=1), vertices[..., 2].max(axis=1)
    cuts = [
        _sample_segments(*_level_cut(vertices[(lowest < z) & (highest > z)], z), step_m)
        for z in levels
    ]
    return np.concatenate(cuts)


def _level_cut(triangles: Float64, z: float) -> tuple[Float64, Float64]:
    """Ends (N, 3) of the segments in which triangles cross the plane at height ``z``."""
    above = triangles[..., 2] > z
    # The corner that is alone on its side; both edges from it cross the plane.
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
    """Points (M, 3) on segments, at most ``step_m`` apart, ends included."""
    pieces = np.ceil(np.linalg.norm(end - start, axis=1) / step_m).astype(int) + 1
    segment = np.repeat(np.arange(len(start)), pieces + 1)
    first = np.cumsum(pieces + 1) - (pieces + 1)
    share = (np.arange(len(segment)) - first[segment]) / pieces[segment]
    return np.asarray(start[segment] + share[:, None] * (end - start)[segment])


def _quarter_centres(
    shape: tuple[int, int], origin_m: tuple[float, float], resolution_m: float
) -> Float64:
    """Centres (rows·columns·4, 2) of the quarters of each cell, map axes, cell by cell."""
    row, column = np.indices(shape)
    corner = np.stack([column, row], axis=-1).reshape(-1, 1, 2)
    quarters = np.array([[0.25, 0.25], [0.75, 0.25], [0.25, 0.75], [0.75, 0.75]])
    return np.asarray(((corner + quarters) * resolution_m + origin_m).reshape(-1, 2))


def _covered(
    world: StreetWorld, T_map_street: Float64, xy_map: Float64, band_m: tuple[float, float]
) -> Bool:
    """Whether a plumb line between the two heights meets a surface, for points (N, 2)."""
    level = np.column_stack([xy_map, np.full(len(xy_map), T_map_street[2, 3])])
    feet = se3.apply(se3.invert(T_map_street), level)
    feet[:, 2] = band_m[1]
    down = np.broadcast_to([0.0, 0.0, band_m[0] - band_m[1]], feet.shape)
    return RayScene(world.soup.vertices, world.settings.threads).blocked(feet, down)
