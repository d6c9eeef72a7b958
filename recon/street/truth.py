"""Ground truth of a whole drive: the surfaces that were seen, and the obstacles."""

from __future__ import annotations

from typing import Final

import numpy as np
from numpy.typing import NDArray

from recon.core.errors import EvaluationError
from recon.core.geometry import se3
from recon.core.kernels.voxels import distinct_keys, pack_keys, unpack_keys
from recon.core.open3d_raycasting import RayScene
from recon.core.values import FREE, OCCUPIED, OccupancyGrid, OccupancyTruth, PointCloud
from recon.core.values.arrays import Float32, Float64, Int32
from recon.street.render import StreetCamera
from recon.street.street import StreetWorld

# Surfaces this far beyond the range are included, as a map may place them slightly nearer.
_BEYOND_M: Final = 2.0
_COMPACT_AT: Final = 4_000_000
_SLICE_M: Final = 0.05
_QUARTERS: Final = np.array([[0.25, 0.25], [0.75, 0.25], [0.25, 0.75], [0.75, 0.75]])


def true_surface(
    camera: StreetCamera, *, range_m: float = 30.0, voxel_m: float = 0.05
) -> PointCloud:
    """Return exact points, one a voxel, on the surfaces that the left camera saw within a range."""
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
    camera: StreetCamera,
    *,
    resolution_m: float = 0.2,
    band_m: tuple[float, float] = (0.3, 2.0),
    range_m: float = 25.0,
    least_frames: int = 1,
    T_map_world: Float64 | None = None,
) -> OccupancyTruth:
    """Return the true surfaces and obstacles on the part of the street that was seen.

    Obstacles are between the heights of the band above the road; the pavement is 0.12 m high. Cells
    are known where ``least_frames`` have seen them from at most ``range_m``. Axes are those of the
    street world, or ``T_map_world``.
    """
    world = camera.world
    T = world.T_map_world if T_map_world is None else T_map_world
    T_map_camera = T @ world.trajectory.T_world_camera
    seen, columns = _Counter(), _Counter()
    for index in range(len(camera)):
        xyz = _visible_points(camera, index, range_m + _BEYOND_M)
        away = np.linalg.norm(xyz, axis=1)
        near = away <= range_m
        cells = np.floor(se3.apply(T_map_camera[index], xyz) / resolution_m).astype(np.int64)
        low = xyz @ world.ground_plane(index)[:3] + world.ground_plane(index)[3] <= band_m[1]
        seen.add(cells[near])
        seen.add(cells[away <= range_m + _BEYOND_M], frames=0)
        columns.add(cells[near & low] * [1, 1, 0])
    keys, frames = seen.counts()
    # The smallest raster of the columns, and which were seen enough.
    places, times = columns.counts()
    if len(places) == 0:
        raise EvaluationError("no surface of the street is in view and in range")
    corner = places[:, :2].min(axis=0)
    width, height = (places[:, :2].max(axis=0) - corner + 1).tolist()
    known = np.zeros((height, width), dtype=np.bool_)
    enough = places[times >= least_frames, :2] - corner
    known[enough[:, 1], enough[:, 0]] = True
    return OccupancyTruth(
        grid=_footprint(world, T @ world.T_world_street, band_m, corner, known.shape, resolution_m),
        seen=known,
        keys=keys,
        frames=frames.astype(np.int32),
        camera=world.camera,
        T_map_camera=T_map_camera,
        range_m=range_m,
        least_frames=least_frames,
    )


def _visible_points(camera: StreetCamera, index: int, range_m: float) -> Float64:
    depth = camera.depth(index, in_mirrors=False).astype(np.float64).ravel()
    rig = camera.world.camera
    near = np.flatnonzero(depth <= range_m)
    v, u = np.divmod(near, rig.width_px)
    offsets = np.stack([u - rig.cx_px, v - rig.cy_px, np.full(len(near), rig.focal_px)], axis=1)
    return np.asarray(offsets * (depth[near] / rig.focal_px)[:, None])


def _thin(xyz: Float32, voxel_m: float) -> Float32:
    keys = pack_keys(np.floor(xyz / voxel_m).astype(np.int64))
    first = np.unique(keys, return_index=True)[1]
    return np.asarray(xyz[np.sort(first)])


class _Counter:
    def __init__(self) -> None:
        self._keys = np.zeros(0, np.int64)
        self._frames = np.zeros(0, np.int64)

    def add(self, cells: NDArray[np.int64], frames: int = 1) -> None:
        """Count the cells (N, 3) of one frame, or none; duplicates count once."""
        keys = distinct_keys(pack_keys(cells))
        self._keys, place = np.unique(np.concatenate([self._keys, keys]), return_inverse=True)
        counts = np.concatenate([self._frames, np.full(len(keys), frames)])
        self._frames = np.bincount(place, weights=counts).astype(np.int64)

    def counts(self) -> tuple[Int32, NDArray[np.int64]]:
        """Return cells (N, 3) in order, and the number of frames in which each appeared."""
        return unpack_keys(self._keys), self._frames


def _footprint(
    world: StreetWorld,
    T_map_street: Float64,
    band_m: tuple[float, float],
    low: Int32,
    shape: tuple[int, ...],
    resolution_m: float,
) -> OccupancyGrid:
    """Return OCCUPIED where a surface lies in the height band, else FREE."""
    rows, columns = shape
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
    corners = np.indices((rows, columns))[::-1].transpose(1, 2, 0).reshape(-1, 1, 2)
    centres = ((corners + _QUARTERS) * resolution_m + origin).reshape(-1, 2)
    # Also where a vertical line between the two heights hits a surface.
    level = np.column_stack([centres, np.full(len(centres), T_map_street[2, 3])])
    feet = se3.apply(se3.invert(T_map_street), level)
    feet[:, 2] = band_m[1]
    down = np.broadcast_to([0.0, 0.0, band_m[0] - band_m[1]], feet.shape)
    hit = RayScene(world.soup.vertices, world.settings.threads).blocked(feet, down)
    occupied |= hit.reshape(rows, columns, 4).any(axis=2)
    values = np.where(occupied, OCCUPIED, FREE).astype(np.int8)
    return OccupancyGrid(values, resolution_m, origin)


def _outlines(vertices: Float64, band_m: tuple[float, float], step_m: float) -> Float64:
    """Return points (N, 3) every ``step_m`` along horizontal cuts through triangles in a band."""
    levels = np.arange(band_m[0], band_m[1] + 1e-9, _SLICE_M)
    lowest, highest = vertices[..., 2].min(axis=1), vertices[..., 2].max(axis=1)
    points = []
    for z in levels:
        triangles = vertices[(lowest < z) & (highest > z)]
        above = triangles[..., 2] > z
        # The corner that is alone on its side of the plane; both edges from it cross the plane.
        lone = np.where(above.sum(axis=1) == 1, above.argmax(axis=1), (~above).argmax(axis=1))
        row = np.arange(len(triangles))
        apex, ends = triangles[row, lone], []
        for step in (1, 2):
            other = triangles[row, (lone + step) % 3]
            along = (z - apex[:, 2]) / (other[:, 2] - apex[:, 2])
            ends.append(apex + along[:, None] * (other - apex))
        start, end = ends
        pieces = np.ceil(np.linalg.norm(end - start, axis=1) / step_m).astype(int) + 1
        segment = np.repeat(np.arange(len(start)), pieces + 1)
        first = np.cumsum(pieces + 1) - (pieces + 1)
        along = (np.arange(len(segment)) - first[segment]) / pieces[segment]
        points.append(start[segment] + along[:, None] * (end - start)[segment])
    return np.concatenate(points)
