"""The map of a drive, assembled from its submaps tile by tile."""

from __future__ import annotations

import math
from collections import Counter
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from itertools import product
from typing import Any, Final

import numpy as np
from numpy.typing import NDArray

from recon.core.values import OccupancyVoxels, PointCloud
from recon.core.values.arrays import Float64
from recon.map import Submap, SubmapMotion
from recon.map.fused_part import KNOWABLE, join_fused
from recon.map.grid import JOINED_CELLS
from recon.map.kernels.raycast import BLOCK_BITS, BLOCK_EDGE
from recon.map.occupancy_part import OccupancyPart, join_occupancy
from recon.map.settings import DriveSettings
from recon.map.submap_records import Submaps
from recon.stereo.cloud import filter_cloud

Tile = tuple[int, int]
_MARGIN_M: Final = 1.0
"""Least margin around a tile for the filters of the fused cloud."""
_LEAST_TILE_M: Final = 5.0
_FUSED_BYTES: Final = 60
_BLOCK_BYTES: Final = 4 * 3 * BLOCK_EDGE**3
_ROW_BITS: Final = 32
_ROW_MASK: Final = (1 << _ROW_BITS) - 1
_ROW_ZERO: Final = 1 << (_ROW_BITS - 1)


@dataclass(frozen=True)
class _Reach:
    """The extent of a submap in tiles, margins included, and its point attributes.

    Attributes:
        fused: Number of voxels in each tile of the fused cloud.
        occupancy: Number of blocks in each tile of the occupancy.
        known: Cloud attributes that the submap has.
        low: Smallest x and y of its occupancy cells.
        high: Largest x and y, plus one.
    """

    fused: Mapping[Tile, int]
    occupancy: Mapping[Tile, int]
    known: frozenset[str]
    low: tuple[int, int]
    high: tuple[int, int]


class DriveMap:
    """Fused cloud and occupancy of a drive; only the submaps of one tile are in memory.

    Args:
        store: The submaps.
        config: The configuration.
        T_map_world: float64 (4, 4), from world to map axes.
        T_corrected_world: float64 (S, 4, 4), a rigid correction of each submap; None = none is
            corrected.
    """

    def __init__(
        self,
        store: Submaps,
        config: DriveSettings,
        T_map_world: Float64,
        T_corrected_world: Float64 | None = None,
    ) -> None:
        self._store = store
        self._config = config
        self._T_map_world = T_map_world
        self._T_corrected_world = T_corrected_world
        self._frames = sum(entry.frames for entry in store.entries)
        tile_m = config.submaps.tile_m
        self._voxels_per_tile = max(1, round(tile_m / config.fusion.voxel_m))
        cells = math.log2(tile_m / config.occupancy.resolution_m)
        # A power of two, so that a tile is a branch of an octree.
        self._blocks_per_tile = 1 << max(0, round(cells) - BLOCK_BITS)
        filters = config.map_filters
        margin_m = max(_MARGIN_M, 2 * (filters.voxel_m or 0.0), filters.radius_m or 0.0)
        self._margin_voxels = math.ceil(margin_m / config.fusion.voxel_m)
        # A cell depends on the cells joined to it, on their blob, and on adjacent cells.
        beyond = config.grid.min_blob_cells + JOINED_CELLS + 2
        self._margin_blocks = math.ceil(beyond / BLOCK_EDGE)
        self._reach = self._fitting_reach()
        shared = frozenset(KNOWABLE).intersection(*(reach.known for reach in self._reach))
        # Attributes missing in one submap are dropped, so that all tiles have the same fields.
        self._known = tuple(name for name in KNOWABLE if name in shared)

    @property
    def cloud_tile_m(self) -> float:
        """Side of a cloud tile."""
        return self._voxels_per_tile * self._config.fusion.voxel_m

    @property
    def occupancy_tile_cells(self) -> int:
        """Side of an occupancy tile in cells; a power of two, at least 8."""
        return self._blocks_per_tile << BLOCK_BITS

    @property
    def _occupancy_tile_m(self) -> float:
        return self.occupancy_tile_cells * self._config.occupancy.resolution_m

    @property
    def submap_of_frame(self) -> NDArray[np.int64]:
        """int64 (N,), number of the submap of each frame."""
        entries = self._store.entries
        return np.repeat(np.arange(len(entries)), [entry.frames for entry in entries])

    @property
    def tiles(self) -> list[Tile]:
        """The tiles with occupancy in them or in their margin, along the drive."""
        return _along_the_drive(reach.occupancy for reach in self._reach)

    @property
    def columns(self) -> tuple[Tile, Tile]:
        """Smallest x and y of the observed voxels, and the largest ones plus one."""
        seen = [reach for reach in self._reach if reach.low != reach.high]
        if not seen:
            return (0, 0), (0, 0)
        low = np.min([reach.low for reach in seen], axis=0)
        high = np.max([reach.high for reach in seen], axis=0)
        return (int(low[0]), int(low[1])), (int(high[0]), int(high[1]))

    def cloud_tiles(self) -> Iterator[tuple[Tile, PointCloud]]:
        """The fused and filtered cloud, frame ``world``, tile by tile along the drive.

        Filters see a margin around the tile, so that the tiles together equal the filtered whole
        (except for statistical limits, which are those of the tile).
        """
        for tile in _along_the_drive(reach.fused for reach in self._reach):
            cloud = self._cloud_of(tile)
            self._config.memory.check("putting the cloud together")
            if len(cloud):
                yield tile, cloud

    def occupancy_tiles(self) -> Iterator[tuple[Tile, OccupancyVoxels]]:
        """The observed voxels, map axes, tile by tile along the drive, each with its margin."""
        for tile in self.tiles:
            voxels = self.occupancy_of(tile)
            self._config.memory.check("putting the occupancy together")
            yield tile, voxels

    def occupancy_of(
        self, tile: Tile, after: Mapping[int, OccupancyPart] | None = None
    ) -> OccupancyVoxels:
        """The observed voxels of a tile, and of its margin.

        Args:
            tile: The tile.
            after: What else was observed at the end of submaps, by their numbers.
        """
        edge, margin = self._blocks_per_tile, self._margin_blocks
        low, high = np.array(tile) * edge - margin, (np.array(tile) + 1) * edge + margin
        # Joined one by one, so that a place passed often takes no more memory than one passed once.
        parts = self._parts(self._near(tile, lambda reach: reach.occupancy), after or {})
        inside = (part.select(_inside(part.blocks[:, :2], low, high)) for part in parts)
        return join_occupancy(inside).voxels(self._config.occupancy.resolution_m)

    def _parts(
        self, near: Sequence[int], after: Mapping[int, OccupancyPart]
    ) -> Iterator[OccupancyPart]:
        """The occupancy of submaps, in order, each followed by what comes after it."""
        for index in sorted({*near, *after}):
            if index in near:
                yield self._submap(index).occupancy
            if index in after:
                yield after[index]

    def inner(self, tile: Tile, voxels: OccupancyVoxels) -> OccupancyVoxels:
        """The voxels of a tile without its margin."""
        keep = (voxels.keys[:, :2] // self.occupancy_tile_cells == tile).all(axis=1)
        return OccupancyVoxels(voxels.keys[keep], voxels.log_odds[keep], voxels.resolution_m)

    def cloud(self) -> PointCloud:
        """The whole cloud, frame ``world``; memory grows with the map."""
        nothing = PointCloud(np.zeros((0, 3), np.float32), frame="world")
        whole = join_clouds([cloud for _, cloud in self.cloud_tiles()])
        return nothing if whole is None else whole

    def voxels(self) -> OccupancyVoxels:
        """All observed voxels, map axes; memory grows with the map."""
        tiles = [self.inner(tile, voxels) for tile, voxels in self.occupancy_tiles()]
        return OccupancyVoxels(
            np.concatenate([np.zeros((0, 3), np.int32), *(tile.keys for tile in tiles)]),
            np.concatenate([np.zeros(0, np.float32), *(tile.log_odds for tile in tiles)]),
            self._config.occupancy.resolution_m,
        )

    def _cloud_of(self, tile: Tile) -> PointCloud:
        """The filtered points of a tile."""
        config, edge, margin = self._config, self._voxels_per_tile, self._margin_voxels
        low, high = np.array(tile) * edge - margin, (np.array(tile) + 1) * edge + margin
        parts = (self._submap(index).fused for index in self._near(tile, lambda reach: reach.fused))
        inside = (part.select(_inside(part.cells[:, [0, 2]], low, high)) for part in parts)
        fused = replace(join_fused(inside), known=self._known)
        # A drive with fewer frames than the minimum count must still give a map.
        least = min(config.fusion.min_count, self._frames)
        points = fused.cloud(config.fusion.voxel_m, least, config.fusion.precise_sigma_m)
        cloud = filter_cloud(points, config.map_filters)
        home = np.floor(cloud.xyz[:, [0, 2]] / np.float32(self.cloud_tile_m))
        return cloud.select((home == tile).all(axis=1))

    def _fitting_reach(self) -> list[_Reach]:
        """The extents of the submaps; tiles are halved until the fullest one fits into memory."""
        limit = self._config.memory.tile_bytes
        while True:
            reach = [self._reach_of(self._submap(n)) for n in range(len(self._store))]
            if limit is None:
                return reach
            cloud = _most(r.fused for r in reach) * _FUSED_BYTES > limit
            blocks = _most(r.occupancy for r in reach) * _BLOCK_BYTES > limit
            cloud &= self.cloud_tile_m >= 2 * _LEAST_TILE_M
            blocks &= self._occupancy_tile_m >= 2 * _LEAST_TILE_M
            if not (cloud or blocks):
                return reach
            self._voxels_per_tile //= 1 + cloud
            self._blocks_per_tile //= 1 + blocks

    def _near(self, tile: Tile, kind: Callable[[_Reach], Mapping[Tile, int]]) -> list[int]:
        """Indices of the submaps with content in a tile or its margin, in order."""
        return [n for n, reach in enumerate(self._reach) if tile in kind(reach)]

    def _reach_of(self, submap: Submap) -> _Reach:
        cells, blocks = submap.fused.cells[:, [0, 2]], submap.occupancy.blocks[:, :2]
        columns = submap.occupancy.cells[:, :2]
        low, high = (
            (columns.min(axis=0), columns.max(axis=0) + 1) if len(columns) else ((0, 0),) * 2
        )
        return _Reach(
            _tiles(cells, self._voxels_per_tile, self._margin_voxels),
            _tiles(blocks, self._blocks_per_tile, self._margin_blocks),
            frozenset(submap.fused.known if len(submap.fused) else KNOWABLE),
            (int(low[0]), int(low[1])),
            (int(high[0]), int(high[1])),
        )

    def _submap(self, index: int) -> Submap:
        """A submap with its correction applied."""
        if self._T_corrected_world is None or np.array_equal(
            self._T_corrected_world[index], np.eye(4)
        ):
            return self._store.get(index)
        motion = SubmapMotion(
            self._T_corrected_world[index],
            self._T_map_world,
            self._config.fusion.voxel_m,
            self._config.occupancy.resolution_m,
        )
        key = ("moved submap", id(self), index)
        return self._store.store.cache.get(key, lambda: self._store.get(index).moved(motion))


def join_clouds(clouds: Sequence[PointCloud]) -> PointCloud | None:
    """Concatenate clouds of one frame; attributes missing in one are dropped, no cloud is None."""
    if not clouds:
        return None
    fields: dict[str, Any] = {}
    for name in ("rgb", "normals", "sigma_m", "confidence", "weight", "count"):
        arrays = [getattr(cloud, name) for cloud in clouds]
        if all(array is not None for array in arrays):
            fields[name] = np.concatenate(arrays)
    xyz = np.concatenate([cloud.xyz for cloud in clouds])
    return PointCloud(xyz, frame=clouds[0].frame, **fields)


def _tiles(cells: NDArray[np.int32], edge: int, margin: int) -> dict[Tile, int]:
    """Number of cells (N, 2) in each tile of ``edge`` cells, its margin included.

    The margin is counted by moving all cells to each of its four corners; the largest count is
    kept.
    """
    found: dict[Tile, int] = {}
    for move in product((-margin, margin), repeat=2):
        column, row = ((cells.astype(np.int64) + move) // edge).T
        # Packed into one integer, since numpy sorts rows slowly.
        packed = (column << _ROW_BITS) + row + _ROW_ZERO
        numbers, counts = np.unique(packed, return_counts=True)
        for number, count in zip(numbers.tolist(), counts.tolist(), strict=True):
            tile = (number >> _ROW_BITS, (number & _ROW_MASK) - _ROW_ZERO)
            found[tile] = max(count, found.get(tile, 0))
    return found


def _most(groups: Iterable[Mapping[Tile, int]]) -> int:
    """Largest sum over all groups of any tile."""
    total: Counter[Tile] = Counter()
    for group in groups:
        total.update(group)
    return max(total.values(), default=0)


def _along_the_drive(groups: Iterable[Mapping[Tile, int]]) -> list[Tile]:
    """All tiles, in the order of the first submap of each."""
    return list(dict.fromkeys(tile for group in groups for tile in sorted(group)))


def _inside(
    cells: NDArray[np.int32], low: NDArray[np.int64], high: NDArray[np.int64]
) -> NDArray[np.bool_]:
    """Which cells (N, 2) lie in [low, high)."""
    return np.asarray(((cells >= low) & (cells < high)).all(axis=1))
