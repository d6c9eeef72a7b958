"""Ground truth of a whole drive: the surfaces that were seen, and the obstacles."""

from __future__ import annotations

from typing import Final

import numpy as np
from numpy.typing import NDArray

from recon.core.errors import EvaluationError
from recon.core.geometry import se3
from recon.core.values import OccupancyTruth, PointCloud
from recon.core.values.arrays import Bool, Float32, Float64
from recon.street.footprint import footprint
from recon.street.render import StreetCamera

_BEYOND_M: Final = 2.0
"""Surfaces this far beyond the range are included, as a map may place them slightly nearer."""
_KEY_BITS: Final = 21
_COMPACT_AT: Final = 4_000_000


def true_surface(
    camera: StreetCamera, *, range_m: float = 30.0, voxel_m: float = 0.05
) -> PointCloud:
    """Return points on the surfaces that the left camera saw.

    Args:
        camera: The rig in its street.
        range_m: Pixels with a larger depth are left out.
        voxel_m: Of the pixels in a voxel one is kept, unmoved, so that every point lies exactly
            on a surface.

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
    camera: StreetCamera,
    *,
    resolution_m: float = 0.2,
    band_m: tuple[float, float] = (0.3, 2.0),
    range_m: float = 25.0,
    least_frames: int = 1,
    T_map_world: Float64 | None = None,
) -> OccupancyTruth:
    """Return True surfaces and obstacles on the part of the street that was seen.

    Args:
        camera: The rig in its street.
        resolution_m: Cell size; cell borders are at multiples of it.
        band_m: Heights above the road between which a surface is an obstacle. The pavement is
            0.12 m high, so a lower band makes it an obstacle.
        range_m: Largest distance from the camera that a frame sees.
        least_frames: Least number of frames that must have seen a cell of the grid.
        T_map_world: The map axes to use; by default those of the street world.

    Raises:
        EvaluationError: No surface is in view and in range.
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
        seen.know(cells[away <= range_m + _BEYOND_M])
        columns.add(cells[near & low] * [1, 1, 0])
    keys, frames = seen.counts()
    raster, known = _raster(*columns.counts(), least_frames)
    return OccupancyTruth(
        grid=footprint(world, T @ world.T_world_street, band_m, (*raster, resolution_m)),
        seen=known,
        keys=keys.astype(np.int32),
        frames=frames.astype(np.int32),
        camera=world.camera,
        T_map_camera=T_map_camera,
        range_m=range_m,
        least_frames=least_frames,
    )


def _raster(
    columns: NDArray[np.int64], frames: NDArray[np.int64], least: int
) -> tuple[tuple[NDArray[np.int64], tuple[int, int]], Bool]:
    """The smallest raster (corner, shape) around columns (N, 3), and which were seen enough."""
    if len(columns) == 0:
        raise EvaluationError("no surface of the street is in view and in range")
    corner = columns[:, :2].min(axis=0)
    width, height = (columns[:, :2].max(axis=0) - corner + 1).tolist()
    known = np.zeros((height, width), dtype=np.bool_)
    enough = columns[frames >= least, :2] - corner
    known[enough[:, 1], enough[:, 0]] = True
    return (corner, (height, width)), known


def _visible_points(camera: StreetCamera, index: int, range_m: float) -> Float64:
    """Return points (N, 3) of one depth map, left camera axes."""
    depth = camera.depth(index).astype(np.float64).ravel()
    rig = camera.world.camera
    near = np.flatnonzero(depth <= range_m)
    v, u = np.divmod(near, rig.width_px)
    offsets = np.stack([u - rig.cx_px, v - rig.cy_px, np.full(len(near), rig.focal_px)], axis=1)
    return np.asarray(offsets * (depth[near] / rig.focal_px)[:, None])


def _thin(xyz: Float32, voxel_m: float) -> Float32:
    """Return the first point in each voxel, in the order given."""
    keys = _pack(np.floor(xyz / voxel_m).astype(np.int64))
    first = np.unique(keys, return_index=True)[1]
    return np.asarray(xyz[np.sort(first)])


class _Counter:
    """Counts the frames in which each cell appears."""

    def __init__(self) -> None:
        self._keys = np.zeros(0, np.int64)
        self._frames = np.zeros(0, np.int64)

    def add(self, cells: NDArray[np.int64]) -> None:
        """Count the cells (N, 3) of one frame; duplicates count once."""
        self._merge(np.unique(_pack(cells)), 1)

    def know(self, cells: NDArray[np.int64]) -> None:
        """Include cells (N, 3) without counting a frame."""
        self._merge(np.unique(_pack(cells)), 0)

    def _merge(self, keys: NDArray[np.int64], count: int) -> None:
        self._keys, place = np.unique(np.concatenate([self._keys, keys]), return_inverse=True)
        frames = np.concatenate([self._frames, np.full(len(keys), count)])
        self._frames = np.bincount(place, weights=frames).astype(np.int64)

    def counts(self) -> tuple[NDArray[np.int64], NDArray[np.int64]]:
        """Return cells (N, 3) in order, and the number of frames in which each appeared."""
        mask = (1 << _KEY_BITS) - 1
        parts = [(self._keys >> shift) & mask for shift in (2 * _KEY_BITS, _KEY_BITS, 0)]
        return np.stack(parts, axis=1) - (1 << (_KEY_BITS - 1)), self._frames


def _pack(cells: NDArray[np.int64]) -> NDArray[np.int64]:
    """Pack each cell (N, 3) into one integer."""
    wide = cells + (1 << (_KEY_BITS - 1))
    return np.asarray((wide[:, 0] << (2 * _KEY_BITS)) | (wide[:, 1] << _KEY_BITS) | wide[:, 2])
