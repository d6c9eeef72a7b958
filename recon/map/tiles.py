"""The map in square tiles, from which everything that leaves it is made.

Each submap is moved to its corrected place and cut at the borders of the tiles, once. A tile is
fused and filtered when it is first asked for, and then kept for all products.
"""

from __future__ import annotations

from collections.abc import Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from functools import reduce
from heapq import merge
from itertools import groupby, product
from operator import itemgetter
from pathlib import Path
from typing import Any, Final

import numpy as np

from recon.core.geometry.se3 import apply, transform_cloud
from recon.core.kernels.voxels import are_among, distinct_keys, pack_keys, unpack_keys
from recon.core.progress import tracked
from recon.core.values import OccupancyVoxels, PointCloud, join_clouds, join_voxels
from recon.core.values.arrays import Float32, Float64, Int64
from recon.core.values.grid import log_odds
from recon.map.builders import Submap
from recon.map.cut import FUSED, OCCUPANCY, Cut, Cutter, Rectangle, TileKey, TileParts
from recon.map.fusion import ALL, FusedPart, join_fused
from recon.map.ground.surface import find_floors
from recon.map.kernels.raycast import BLOCK_BITS
from recon.map.occupancy.bodies import FrameObservations
from recon.map.occupancy.gone import GONE, find_gone
from recon.map.occupancy.moving import CellEvidence, cell_evidence, find_moved
from recon.map.occupancy.part import OccupancyPart, join_occupancy
from recon.map.settings import DriveSettings
from recon.stereo.frame import drop_islands

_POINTS: Final = "points"
_VOXELS: Final = "voxels"
_FLOORS: Final = "floors"
_REMOVED: Final = "removed"


@dataclass(frozen=True)
class Tile:
    """A square of the map, seen from above; its content is made when it is first asked for."""

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
        return self.tiles.voxels(self.key)


class Tiles:
    """A map cut into tiles, made by `of_submaps`; iterating gives them along the drive.

    A tile is ``edge_cells`` voxels wide, a power of two, at least 8.

    Attributes:
        extent: Smallest x and y of the cells that submaps observed, and the largest plus one.
        submap_of_frame: int64 (N,), number of the submap of each frame; -1 between two drives.
        looks: What single frames saw: what they show to have moved is left out of clouds. None = it
            is not known, and nothing is left out.
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
        self._cutter = Cutter(config, T_map_world, halvings)
        self.edge_cells, self.edge_m = self._cutter.edge_cells, self._cutter.edge_m
        self._parts = TileParts(self.edge_m, path)
        self._chain = DriveChain(self._parts)
        self._known: tuple[str, ...] = ALL
        self.observations: FrameObservations | None = None
        self.extent: tuple[TileKey, TileKey] = ((0, 0), (0, 0))
        self.submap_of_frame: Int64 = np.zeros(0, np.int64)

    @classmethod
    def of_submaps(
        cls,
        submaps: Iterable[Submap],
        config: DriveSettings,
        T_map_world: Float64,
        T_corrected_world: Float64 | None = None,
        *,
        drives: Sequence[int] = (),
    ) -> Tiles:
        """Cut the map of drives; tiles are halved until the fullest one fits into memory.

        Submaps are read again where tiles are halved. ``T_corrected_world``, float64 (S, 4, 4), is
        a rigid correction of each; None = none. ``drives`` is the number of submaps of each drive,
        in order: what a later one saw counts more; empty = all are of one.
        """
        halvings, tiles = 0, cls(config, T_map_world)
        while not tiles._take(tiles._cutter.cut(submaps, tiles._parts, T_corrected_world), drives):
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
        """Return the tiles of submaps that others cut, from their files in order; None = too large.

        The tiles were halved ``halvings`` times; what is made of them goes to ``path``.
        """
        tiles = cls(config, T_map_world, halvings, path)
        cut = Cut.joined([tiles._parts.adopt(file) for file in files])
        return tiles if tiles._take(cut, drives) else None

    @property
    def resolution_m(self) -> float:
        return self.config.occupancy.resolution_m

    def __len__(self) -> int:
        return len(self._parts.keys)

    def __iter__(self) -> Iterator[Tile]:
        return tracked([Tile(key, self) for key in self._parts.keys], "tiles")

    def bounds(self, key: TileKey) -> Rectangle:
        return self._parts.bounds(key)

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
        if self._parts.numbers(FUSED, key) and not self._parts.numbers(_POINTS, key):
            for kind, cloud in zip((_POINTS, _REMOVED), self._fused(key), strict=True):
                self._parts.put(kind, key, cloud.arrays)
            self._parts.drop(FUSED, key)
            self.config.memory.check("putting the cloud together")
        found = self._parts.read(_POINTS, key)
        return join_clouds(PointCloud(**tree, frame="map") for _, tree in found)

    def voxels(self, key: TileKey) -> OccupancyVoxels:
        return self.bounds(key).voxels(self.wide_voxels(key))

    def wide_voxels(
        self, key: TileKey, after: Mapping[int, OccupancyPart] | None = None
    ) -> OccupancyVoxels:
        """Return the observed voxels of a tile and of the margin that its grid cells depend on.

        ``after`` is what else was observed at the end of submaps, by their numbers.
        """
        if self._parts.numbers(OCCUPANCY, key) and not self._parts.numbers(_VOXELS, key):
            joined = self._chain.joined(key, note=self.config.fusion.remove_moving)
            voxels = joined.voxels(self.resolution_m)
            if self.config.fusion.remove_moving and self.observations is not None and len(voxels):
                gone = find_gone(voxels, self.observations.views(voxels.centres_m))
                voxels = replace(voxels, log_odds=np.where(gone, GONE, voxels.log_odds))
            self._parts.put(_VOXELS, key, {"keys": voxels.keys, "log_odds": voxels.log_odds})
            self.config.memory.check("putting the occupancy together")
        found = self._parts.read(_VOXELS, key)
        seen = (OccupancyVoxels(**tree, resolution_m=self.resolution_m) for _, tree in found)
        voxels = join_voxels(seen, self.resolution_m)
        if not after:
            return voxels
        wide = self.bounds(key).wider(self._cutter.grid_margin_m)
        inside = {n: p.select(wide.contains(self._cutter.centres_m(p))) for n, p in after.items()}
        return self._chain.changed(key, voxels, inside)

    def cloud_in(self, rectangle: Rectangle) -> PointCloud:
        clouds = map(self.cloud, self._parts.under(rectangle))
        return join_clouds(cloud.select(rectangle.contains(cloud.xyz)) for cloud in clouds)

    def voxels_in(self, rectangle: Rectangle) -> OccupancyVoxels:
        found = map(self.voxels, self._parts.under(rectangle))
        return join_voxels(map(rectangle.voxels, found), self.resolution_m)

    def floors_in(self, rectangle: Rectangle) -> Float32:
        """Return float32 (N, 3), what `find_floors` finds in a rectangle."""
        found = [np.zeros((0, 3), np.float32)]
        for key in self._parts.under(rectangle):
            self.make_voxels(key)
            found += [tree["xyz"] for _, tree in self._parts.read(_FLOORS, key)]
        xyz = np.concatenate(found)
        return xyz[rectangle.contains(xyz)]

    def evidence(self, key: TileKey, drive: int) -> CellEvidence:
        """Return what one of the drives saw in a tile and its margin."""
        self.wide_voxels(key)
        return self._chain.evidence(key, drive)

    def make_voxels(self, key: TileKey) -> None:
        """Make the voxels of a tile, and find the floors among them, unless that is done."""
        if not self._parts.numbers(_FLOORS, key):
            self._parts.put(_FLOORS, key, {"xyz": find_floors(self.voxels(key))})

    def save(self) -> None:
        """Make the file of the tiles readable for `adopt`, or `OutputError`."""
        self._parts.save({})

    def adopt(self, files: Iterable[Path]) -> None:
        """Take what others made of tiles from their files; a damaged one is a `FormatError`."""
        for file in files:
            self._parts.adopt(file)

    def _take(self, cut: Cut, drives: Sequence[int]) -> bool:
        """Take over what is known of all submaps; False = a tile is too large."""
        self.extent, self.submap_of_frame = cut.extent, cut.submap_of_frame(drives)
        self._chain.drive_of = np.repeat(np.arange(len(drives)), np.array(drives, np.int64))
        # Attributes missing in one submap are dropped, so that all tiles have the same fields.
        self._known = tuple(name for name in ALL if name in cut.known)
        return cut.fits(self._cutter.limit_bytes)

    def _fused(self, key: TileKey) -> tuple[PointCloud, PointCloud]:
        """Return the points of a tile, frame ``map``: the filtered ones, and those that moved."""
        kept, removed, fusion = [], [], self.config.fusion
        numbered = ((n, FusedPart.from_tree(tree)) for n, tree in self._parts.read(FUSED, key))
        for drive, parts in groupby(numbered, key=self._chain.drive):
            fused = join_fused(part for _, part in parts)
            moved = np.zeros(len(fused), np.bool_)
            if fusion.remove_moving and self.observations is not None:
                points = apply(self._T_map_world, fused.points(fusion.voxel_m))
                counted = fused.enough(self._least_frames, fusion.voxel_m)
                voxels, evidence = self.wide_voxels(key), self._chain.evidence(key, drive)
                sigma_m = fused.frame_sigma_m
                moved = find_moved(points, sigma_m, counted, voxels, evidence, self.observations)
            kept.append(fused.select(~moved))
            removed.append(fused.select(moved))
        cloud = self._exported(kept)
        cloud = drop_islands(cloud, self.config.island_radii_m(cloud))
        return self._placed(key, cloud), self._placed(key, self._exported(removed))

    def _exported(self, parts: Iterable[FusedPart]) -> PointCloud:
        """Return the points of voxels that enough frames saw, frame ``world``."""
        fused = join_fused(parts).knowing(self._known)
        return fused.cloud(self.config.fusion.voxel_m, self._least_frames)

    @property
    def _least_frames(self) -> int:
        """How many frames must see a point; a drive of fewer must still give a map."""
        return min(self.config.fusion.min_count, len(self.submap_of_frame))

    def _placed(self, key: TileKey, cloud: PointCloud) -> PointCloud:
        """Return the points in a tile, frame ``map``, of a cloud in frame ``world``."""
        placed = transform_cloud(cloud, self._T_map_world, frame="map")
        return placed.select(self.bounds(key).contains(placed.xyz))


_EVIDENCE: Final = "evidence"
_OLD: Final = log_odds(0.85)
"""Most log-odds that earlier drives keep: five rays of a later one free what was occupied."""


class DriveChain:
    """Chains what submaps observed in a tile, drive by drive: a later drive counts more.

    ``drive_of``, int64 (S,), is the drive of each submap; empty = all are of one.
    """

    def __init__(self, parts: TileParts) -> None:
        self._parts = parts
        self.drive_of: Int64 = np.zeros(0, np.int64)

    def drive(self, numbered: tuple[int, Any]) -> int:
        return int(self.drive_of[numbered[0]]) if len(self.drive_of) else 0

    def joined(self, key: TileKey, *, note: bool) -> OccupancyPart:
        """Join what all drives observed in a tile; ``note`` what each saw, for `evidence`."""

        def seen() -> Iterator[OccupancyPart]:
            for drive, part in self._drives(key):
                if note:
                    cells, evidence = cell_evidence(part)
                    noted = {"cells": cells, "log_odds": evidence}
                    self._parts.put(_EVIDENCE, key, noted, drive)
                yield part

        return _outdone(seen())

    def evidence(self, key: TileKey, drive: int) -> CellEvidence:
        """Return the `cell_evidence` of a drive, noted when the tile was joined."""
        for number, tree in self._parts.read(_EVIDENCE, key):
            if number == drive:
                return tree["cells"], tree["log_odds"]
        return np.zeros(0, np.int64), np.zeros(0, np.float32)

    def changed(
        self, key: TileKey, seen: OccupancyVoxels, after: Mapping[int, OccupancyPart]
    ) -> OccupancyVoxels:
        """Make the voxels of a tile again where ``after`` the end of submaps more was observed."""
        blocks = distinct_keys(np.concatenate([part.rows.blocks for part in after.values()]))
        # Whether a surface crosses a voxel depends on what hit the blocks that touch its own.
        changed, needed = _grown(blocks, 1), _grown(blocks, 2)
        joined = _outdone(part for _, part in self._drives(key, after, needed))
        anew, packed = joined.voxels(seen.resolution_m, changed), pack_keys(seen.keys)
        gone = are_among(pack_keys(anew.keys), packed[seen.log_odds == GONE])
        most = np.where(gone, GONE, np.float32(np.inf))
        anew = replace(anew, log_odds=np.minimum(anew.log_odds, most))
        kept = seen.select(~are_among(pack_keys(seen.keys >> BLOCK_BITS), changed))
        return join_voxels([kept, anew], seen.resolution_m)

    def _drives(
        self,
        key: TileKey,
        after: Mapping[int, OccupancyPart] | None = None,
        blocks: Int64 | None = None,
    ) -> Iterator[tuple[int, OccupancyPart]]:
        """Return what each drive observed in a tile, in their order.

        ``after`` is what else was observed at the end of submaps, by their numbers; only packed
        ``blocks`` are looked at, None = all.
        """
        own = ((n, OccupancyPart.from_tree(tree)) for n, tree in self._parts.read(OCCUPANCY, key))
        # Of one number, that of the submap comes first.
        numbered = merge(own, sorted((after or {}).items()), key=itemgetter(0))
        for drive, parts in groupby(numbered, key=self.drive):
            # Joined one by one, so that a place passed often takes no more memory than others.
            yield (
                drive,
                join_occupancy(
                    part if blocks is None else part.select(are_among(part.rows.blocks, blocks))
                    for _, part in parts
                ),
            )


def _outdone(drives: Iterable[OccupancyPart]) -> OccupancyPart:
    """Chain what drives observed; little of the older counts for a later one."""
    return reduce(lambda old, new: join_occupancy([old, new.outdoing(_OLD)]), drives)


def _grown(blocks: Int64, by: int) -> Int64:
    """Return packed blocks with those up to ``by`` blocks away from one on each axis."""
    steps = np.array(list(product(range(-by, by + 1), repeat=3)))
    around = unpack_keys(blocks)[:, None] + steps
    return distinct_keys(pack_keys(around.reshape(-1, 3)))
