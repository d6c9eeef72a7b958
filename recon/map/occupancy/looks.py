"""What single frames saw of some cells: their kept rays, cast again where they matter."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from dataclasses import dataclass, field
from functools import lru_cache
from typing import Final

import numpy as np
from numpy.typing import NDArray

from recon.core.geometry.se3 import apply, invert
from recon.core.kernels.voxels import find_keys, pack_keys, unpack_keys
from recon.core.values import PointCloud, RayCloud
from recon.core.values.arrays import Bool, Float64, Int8
from recon.map.kernels.raycast import BLOCK_BITS, BLOCK_EDGE, cast_rays, make_blocks
from recon.map.occupancy.builder import SPREAD_SIGMAS, OccupancySettings, frame_rays

_KEPT_FRAMES: Final = 64
"""Frames whose rays stay in memory: neighbouring tiles need the same ones."""
_FIRST_BLOCKS: Final = 256
_BINS: Final = 128
"""Directions on each axis, by which rays that may matter are chosen."""
_WIDEST: Final = 1.5
"""Largest slope of a ray against the optical axis that has a bin of its own."""


@dataclass(frozen=True, eq=False)
class Looks:
    """The frames of all drives of a map, in order.

    Attributes:
        settings: How rays become occupancy.
        T_map_camera: float64 (F, 4, 4), where each frame was taken.
        rays: Gives the kept rays of a frame by its number here.
    """

    settings: OccupancySettings
    T_map_camera: Float64
    rays: Callable[[int], RayCloud]
    _read: Callable[[int], RayCloud] = field(init=False, repr=False)

    def __post_init__(self) -> None:
        object.__setattr__(self, "_read", lru_cache(_KEPT_FRAMES)(self.rays))

    def at(self, keys: NDArray[np.int64]) -> Iterator[Int8]:
        """Yield what each frame near some cells saw in them, int8 (N,).

        1 where it hit something, -1 where it looked through, 0 where it saw neither.

        Args:
            keys: int64 (N,), packed cells in map axes.
        """
        cells = unpack_keys(keys).astype(np.int64)
        centres = (cells + 0.5) * self.settings.resolution_m
        origins = self.T_map_camera[:, :3, 3]
        reach_m = self.settings.max_range_m + self.settings.resolution_m
        low, high = centres.min(axis=0) - reach_m, centres.max(axis=0) + reach_m
        for frame in np.flatnonzero(((origins > low) & (origins < high)).all(axis=1)):
            T = self.T_map_camera[frame]
            ahead = apply(invert(T), centres)
            seen = (ahead[:, 2] > 0) & (np.linalg.norm(ahead, axis=1) < reach_m)
            if seen.any():
                cloud = self._read(int(frame)).cloud()
                chosen = _towards(cloud.xyz, ahead[seen], self.settings.resolution_m)
                yield self._cast(cloud.select(chosen), T, cells)

    def _cast(self, cloud: PointCloud, T_map_camera: Float64, cells: NDArray[np.int64]) -> Int8:
        """Return what the rays of one frame did to cells (N, 3)."""
        rays = frame_rays(cloud, T_map_camera, self.settings)
        evidence = cast_rays(make_blocks(_FIRST_BLOCKS), rays, SPREAD_SIGMAS)
        used = int(evidence.used[0])
        order = np.argsort(evidence.keys[:used])
        place, known = find_keys(pack_keys(cells >> BLOCK_BITS), evidence.keys[:used][order])
        local = np.ravel_multi_index(tuple((cells[known] % BLOCK_EDGE).T), (BLOCK_EDGE,) * 3)
        seen = np.zeros(len(cells), np.int8)
        seen[known] = np.sign(evidence.values[order[place[known]], local])
        return seen


def _towards(xyz: NDArray[np.float32], cells_m: Float64, edge_m: float) -> Bool:
    """Return which points (N, 3) lie on rays that may cross cells (M, 3); camera axes."""
    depth = np.maximum(cells_m[:, 2:], edge_m)
    slopes = cells_m[:, :2] / depth
    size = (1 + np.abs(slopes)) * edge_m * np.sqrt(3.0) / 2 / depth
    first, last = (_bins(slopes + sign * size) for sign in (-1.0, 1.0))
    # Rectangles of bins are counted at their corners, and summed up once.
    count = np.zeros((_BINS + 1, _BINS + 1), np.int64)
    for x, y, sign in ((first, first, 1), (last, last, 1), (first, last, -1), (last, first, -1)):
        ends = [c[:, axis] + (c is last) for axis, c in enumerate((x, y))]
        np.add.at(count, tuple(ends), sign)
    wanted = count.cumsum(axis=0).cumsum(axis=1)[:-1, :-1] > 0
    ahead = xyz[:, 2] > 0
    chosen: Bool = wanted[tuple(_bins(xyz[:, :2] / np.where(ahead, xyz[:, 2], 1.0)[:, None]).T)]
    return ahead & chosen


def _bins(slopes: NDArray[np.floating]) -> NDArray[np.int64]:
    """Return the bins of slopes (N, 2); what is steeper shares the outermost."""
    places = np.floor((slopes + _WIDEST) * (_BINS / (2 * _WIDEST)))
    return np.asarray(np.clip(places, 0, _BINS - 1), np.int64)
