"""The map of a drive in square tiles, from which everything that leaves the map is made.

Each submap is read, moved to where the drive has put it, and cut at the borders of the tiles, once.
A tile is fused and filtered when something first asks for it, and then kept: all products of the
map take the same tiles, with a few of them in memory at a time.
"""

from __future__ import annotations

import math
from collections.abc import Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from itertools import groupby
from pathlib import Path
from typing import Final

import numpy as np
from numpy.typing import NDArray

from recon.core.geometry.axes import transform_cloud
from recon.core.geometry.se3 import apply
from recon.core.values import OccupancyVoxels, PointCloud
from recon.core.values.arrays import Bool, Float32, Float64
from recon.map.cut import Cut
from recon.map.drive_chain import OCCUPANCY, DriveChain
from recon.map.fusion.part import KNOWABLE, FusedPart, join_fused
from recon.map.ground.floor import find_floors
from recon.map.ground.grid import JOINED_CELLS
from recon.map.joined import cloud_tree, in_window, join_clouds, join_voxels, voxel_tree
from recon.map.kernels.raycast import BLOCK_BITS, BLOCK_EDGE
from recon.map.occupancy.moving import find_moved
from recon.map.occupancy.part import OccupancyPart
from recon.map.settings import DriveSettings
from recon.map.store.tile_parts import TileKey, TileParts
from recon.map.submaps import Submap, SubmapMotion
from recon.map.window import Window
from recon.stereo.cloud.filters import filter_cloud

_FUSED: Final = "fused"
_POINTS: Final = "points"
_VOXELS: Final = "voxels"
_FLOORS: Final = "floors"
_REMOVED: Final = "removed"
_FILTER_MARGIN_M: Final = 1.0
"""Least margin around a tile for the filters of the fused cloud."""
_LEAST_TILE_M: Final = 5.0
_FUSED_BYTES: Final = 60
_BLOCK_BYTES: Final = 4 * 3 * BLOCK_EDGE**3


@dataclass(frozen=True)
class Tile:
    """A square of the map, seen from above; its content is made when it is first asked for.

    Attributes:
        key: Its column and row.
        tiles: The map.
    """

    key: TileKey
    tiles: Tiles

    @property
    def cloud(self) -> PointCloud:
        """Its fused and filtered points, frame ``map``."""
        return self.tiles.cloud(self.key)

    @property
    def removed(self) -> PointCloud:
        """The points left out of its cloud since they moved, frame ``map``; not filtered."""
        return self.tiles.removed(self.key)

    @property
    def voxels(self) -> OccupancyVoxels:
        """Its observed voxels."""
        return self.tiles.voxels(self.key)


class Tiles:
    """A map cut into tiles; iterating gives them along the drive.

    `of_submaps` cuts a drive; `put_cloud` and `put_voxels` add what is fused already.

    Args:
        config: The configuration.
        T_map_world: float64 (4, 4), from world to map axes.
        halvings: How often the tiles of the configuration are halved.
        path: File for what is in them; None = a temporary one.

    Attributes:
        config: The configuration.
        edge_cells: Side of a tile in voxels; a power of two, at least 8.
        extent: Smallest x and y of the cells that submaps observed, and the largest plus one.
        submap_of_frame: int64 (N,), number of the submap of each frame; -1 between two drives.
    """

    def __init__(
        self,
        config: DriveSettings,
        T_map_world: Float64,
        halvings: int = 0,
        path: Path | None = None,
    ) -> None:
        self.config = config
        self._T_map_world = T_map_world
        cells = math.log2(config.submaps.tile_m / config.occupancy.resolution_m)
        # A power of two, so that a tile is a branch of an octree.
        self.edge_cells = 1 << max(BLOCK_BITS, round(cells) - halvings)
        self._parts = TileParts(self.edge_m, path)
        self._chain = DriveChain(self._parts)
        self._known: tuple[str, ...] = KNOWABLE
        self.extent: tuple[TileKey, TileKey] = ((0, 0), (0, 0))
        self.submap_of_frame: NDArray[np.int64] = np.zeros(0, np.int64)
        filters = config.map_filters
        margin_m = max(_FILTER_MARGIN_M, 2 * (filters.voxel_m or 0.0), filters.radius_m or 0.0)
        # A voxel more, since a point may lie anywhere in its voxel.
        self._filter_margin_m = margin_m + config.fusion.voxel_m
        # A cell of a grid depends on the cells joined to it, on their blob, and on adjacent cells;
        # whether a point moved, on the voxels that touch its own.
        beyond = config.grid.min_blob_cells + JOINED_CELLS + 2
        beyond = max(beyond, math.ceil(self._filter_margin_m / self.resolution_m) + 1)
        self._grid_margin_m = math.ceil(beyond / BLOCK_EDGE) * self._block_m

    @classmethod
    def of_submaps(
        cls,
        submaps: Iterable[Submap],
        config: DriveSettings,
        T_map_world: Float64,
        T_corrected_world: Float64 | None = None,
        *,
        drives: Sequence[int] = (),
        fuse: bool = True,
    ) -> Tiles:
        """Cut the map of drives; tiles are halved until the fullest one fits into memory.

        Args:
            submaps: The submaps, in order; read again where tiles are halved.
            config: The configuration.
            T_map_world: float64 (4, 4), from world to map axes.
            T_corrected_world: float64 (S, 4, 4), a rigid correction of each submap; None = none is
                corrected.
            drives: Number of submaps of each drive, in the order of the drives: what a later one
                saw counts more. Empty = all are of one.
            fuse: Make the cloud of the submaps; else it is put in as it was written.

        Raises:
            FormatError: A submap is damaged.
            OutputError: There is no room for the tiles.
        """
        halvings, tiles = 0, cls(config, T_map_world)
        while not tiles._take(tiles.cut(submaps, T_corrected_world, fuse=fuse), drives):
            halvings += 1
            tiles = cls(config, T_map_world, halvings)
        return tiles

    @classmethod
    def of_files(
        cls,
        files: Iterable[Path],
        config: DriveSettings,
        T_map_world: Float64,
        *,
        halvings: int = 0,
        drives: Sequence[int] = (),
        path: Path | None = None,
    ) -> Tiles | None:
        """Return the tiles of submaps that others have cut; None = the tiles are too large.

        Args:
            files: What `save` wrote, in the order of the submaps; a damaged one is a `FormatError`.
            config: As for `of_submaps`, like all that is not listed here.
            T_map_world: As before.
            halvings: How often the tiles were halved.
            drives: Number of submaps of each drive.
            path: File for what is made of them.
        """
        tiles = cls(config, T_map_world, halvings, path)
        cut = Cut.joined([tiles._parts.adopt(file) for file in files])
        return tiles if tiles._take(cut, drives) else None

    @property
    def resolution_m(self) -> float:
        """Edge of a voxel."""
        return self.config.occupancy.resolution_m

    @property
    def edge_m(self) -> float:
        """Side of a tile."""
        return self.edge_cells * self.resolution_m

    def __len__(self) -> int:
        return len(self._parts.keys)

    def __iter__(self) -> Iterator[Tile]:
        return (Tile(key, self) for key in self._parts.keys)

    def window(self, key: TileKey) -> Window:
        """Return the bounds of a tile."""
        return self._parts.window(key)

    def put_cloud(self, cloud: PointCloud) -> None:
        """Add points that are fused and filtered, frame ``map``."""
        for key, inside in self._parts.near(cloud.xyz, 0.0):
            self._parts.put(_POINTS, key, cloud_tree(cloud.select(inside)))

    def put_voxels(self, voxels: OccupancyVoxels) -> None:
        """Add observed voxels; none is given twice."""
        for key, inside in self._parts.near(voxels.centres_m, 0.0):
            self._parts.put(_VOXELS, key, voxel_tree(voxels.select(inside)))

    def removed(self, key: TileKey) -> PointCloud:
        """Return the points that are left out of the cloud of a tile since they moved."""
        self.cloud(key)
        found = self._parts.read(_REMOVED, key)
        return join_clouds(PointCloud(**tree, frame="map") for _, tree in found)

    def cloud(self, key: TileKey) -> PointCloud:
        """Return the fused and filtered points of a tile, frame ``map``, without what moved.

        Filters see a margin around the tile, so that the tiles together equal the filtered whole
        (except for statistical limits, which are those of the tile).
        """
        if self._parts.numbers(_FUSED, key):
            for kind, cloud in zip((_POINTS, _REMOVED), self._fused(key), strict=True):
                self._parts.put(kind, key, cloud_tree(cloud))
            self._parts.drop(_FUSED, key)
            self.config.memory.check("putting the cloud together")
        found = self._parts.read(_POINTS, key)
        return join_clouds(PointCloud(**tree, frame="map") for _, tree in found)

    def voxels(self, key: TileKey) -> OccupancyVoxels:
        """Return the observed voxels of a tile, map axes."""
        return in_window(self.wide_voxels(key), self.window(key))

    def wide_voxels(
        self, key: TileKey, after: Mapping[int, OccupancyPart] | None = None
    ) -> OccupancyVoxels:
        """Return the observed voxels of a tile and of the margin that its grid cells depend on.

        Args:
            key: The tile.
            after: What else was observed at the end of submaps, by their numbers.
        """
        if self._parts.numbers(OCCUPANCY, key) and not self._parts.numbers(_VOXELS, key):
            joined = self._chain.joined(key, note=self.config.fusion.remove_moving)
            self._parts.put(_VOXELS, key, voxel_tree(joined.voxels(self.resolution_m)))
            self.config.memory.check("putting the occupancy together")
        found = self._parts.read(_VOXELS, key)
        seen = (OccupancyVoxels(**tree, resolution_m=self.resolution_m) for _, tree in found)
        voxels = join_voxels(seen, self.resolution_m)
        if not after:
            return voxels
        wide = self.window(key).wider(self._grid_margin_m)
        inside = {n: p.select(wide.contains(self._centres_m(p))) for n, p in after.items()}
        return self._chain.changed(key, voxels, inside)

    def cloud_in(self, window: Window) -> PointCloud:
        """Return the points in a window, frame ``map``."""
        clouds = map(self.cloud, self._parts.under(window))
        return join_clouds(cloud.select(window.contains(cloud.xyz)) for cloud in clouds)

    def voxels_in(self, window: Window) -> OccupancyVoxels:
        """Return the voxels with their centres in a window."""
        found = map(self.voxels, self._parts.under(window))
        return join_voxels([in_window(voxels, window) for voxels in found], self.resolution_m)

    def floors_in(self, window: Window) -> Float32:
        """Return float32 (N, 3), what `find_floors` finds in a window."""
        found = [np.zeros((0, 3), np.float32)]
        for key in self._parts.under(window):
            self.make_voxels(key)
            found += [tree["xyz"] for _, tree in self._parts.read(_FLOORS, key)]
        xyz = np.concatenate(found)
        return xyz[window.contains(xyz)]

    def make_voxels(self, key: TileKey) -> None:
        """Make the voxels of a tile, and find the floors among them, unless that is done."""
        if not self._parts.numbers(_FLOORS, key):
            self._parts.put(_FLOORS, key, {"xyz": find_floors(self.voxels(key))})

    @property
    def _block_m(self) -> float:
        return BLOCK_EDGE * self.resolution_m

    def cut(
        self,
        submaps: Iterable[Submap],
        T_corrected_world: Float64 | None = None,
        *,
        first: int = 0,
        fuse: bool = True,
    ) -> Cut:
        """Cut submaps into the tiles; it ends early where a tile does not fit into memory.

        Args:
            submaps: Consecutive submaps.
            T_corrected_world: As for `of_submaps`, of these.
            first: Number of the first one in its map.
            fuse: As for `of_submaps`.
        """
        cut = Cut()
        for place, submap in enumerate(submaps):
            T = None if T_corrected_world is None else T_corrected_world[place]
            fused = submap.fused if fuse else submap.fused.select(np.zeros(0, np.intp))
            moved = self._moved(replace(submap, fused=fused), T)
            cut.add(moved)
            for kind, key, part, nbytes in self._pieces(moved):
                self._parts.put(kind, key, part.to_tree(), first + place)
                cut.nbytes[kind, key] += nbytes
            if not cut.fits(self._limit):
                break
            del submap, moved  # before the next one is read
        return cut

    def save(self, cut: Cut | None = None) -> None:
        """Make the file of the tiles readable for `of_files` and `adopt`, or `OutputError`."""
        self._parts.save({} if cut is None else cut.to_tree())

    def adopt(self, files: Iterable[Path]) -> None:
        """Take what others made of tiles from their files; a damaged one is a `FormatError`."""
        for file in files:
            self._parts.adopt(file)

    @property
    def _limit(self) -> int | None:
        """Largest size of a tile in memory, if it could be smaller."""
        small = self.edge_m < 2 * _LEAST_TILE_M or self.edge_cells == BLOCK_EDGE
        return None if small else self.config.memory.tile_bytes

    def _take(self, cut: Cut, drives: Sequence[int]) -> bool:
        """Note what is known of all submaps, and of which drives they are; False = too large."""
        self.extent, self.submap_of_frame = cut.extent, cut.submap_of_frame(drives)
        self._chain.drive_of = np.repeat(np.arange(len(drives)), np.array(drives, np.int64))
        # Attributes missing in one submap are dropped, so that all tiles have the same fields.
        self._known = tuple(name for name in KNOWABLE if name in cut.known)
        return cut.fits(self._limit)

    def _moved(self, submap: Submap, T_corrected_world: Float64 | None) -> Submap:
        """Return a submap with its correction applied."""
        if T_corrected_world is None or np.array_equal(T_corrected_world, np.eye(4)):
            return submap
        voxel_m = self.config.fusion.voxel_m
        return submap.moved(
            SubmapMotion(T_corrected_world, self._T_map_world, voxel_m, self.resolution_m)
        )

    def _pieces(
        self, submap: Submap
    ) -> Iterator[tuple[str, TileKey, FusedPart | OccupancyPart, int]]:
        """Yield a submap in pieces: kind, tile, content, and the bytes that joining it takes."""
        fused, occupancy, voxel_m = submap.fused, submap.occupancy, self.config.fusion.voxel_m
        centres_m = apply(self._T_map_world, (fused.cells + 0.5) * voxel_m)
        for key, inside in self._parts.near(centres_m, self._filter_margin_m):
            yield _FUSED, key, fused.select(inside), int(inside.sum()) * _FUSED_BYTES
        for key, inside in self._parts.near(self._centres_m(occupancy), self._grid_margin_m):
            yield OCCUPANCY, key, occupancy.select(inside), int(inside.sum()) * _BLOCK_BYTES

    def _centres_m(self, part: OccupancyPart) -> Float64:
        """Return float64 (B, 3), centres of the blocks of a part."""
        return np.asarray((part.blocks + 0.5) * self._block_m)

    def _fused(self, key: TileKey) -> tuple[PointCloud, PointCloud]:
        """Return the points of a tile, frame ``map``: the filtered ones, and those that moved."""
        kept, removed = [], []
        numbered = ((n, FusedPart.from_tree(tree)) for n, tree in self._parts.read(_FUSED, key))
        for drive, parts in groupby(numbered, key=self._chain.drive):
            fused = join_fused(part for _, part in parts)
            moved = self._moved_rows(key, drive, fused)
            kept.append(fused.select(~moved))
            removed.append(fused.select(moved))
        cloud = filter_cloud(self._exported(kept), self.config.map_filters)
        return self._placed(key, cloud), self._placed(key, self._exported(removed))

    def _exported(self, parts: Iterable[FusedPart]) -> PointCloud:
        """Return the points of voxels that enough frames saw, frame ``world``."""
        fusion = self.config.fusion
        # A drive with fewer frames than the minimum count must still give a map.
        least = min(fusion.min_count, len(self.submap_of_frame))
        fused = replace(join_fused(parts), known=self._known)
        return fused.cloud(fusion.voxel_m, least)

    def _placed(self, key: TileKey, cloud: PointCloud) -> PointCloud:
        """Return the points in a tile, frame ``map``, of a cloud in frame ``world``."""
        placed = transform_cloud(cloud, self._T_map_world, frame="map")
        return placed.select(self.window(key).contains(placed.xyz))

    def _moved_rows(self, key: TileKey, drive: int, fused: FusedPart) -> Bool:
        """Return which rows of what a drive fused in a tile and its margin are of what moved."""
        fusion = self.config.fusion
        if not fusion.remove_moving:
            return np.zeros(len(fused), np.bool_)
        voxels = self.wide_voxels(key)
        passed = self._chain.passed(key, drive)
        return find_moved(fused, fusion.voxel_m, self._T_map_world, voxels, passed)
