"""Submaps cut into the square tiles of a map, and the file that keeps the pieces by tile."""

from __future__ import annotations

import math
from collections import Counter, defaultdict
from collections.abc import Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from itertools import product
from pathlib import Path
from typing import Any, Final

import numpy as np
from numpy.typing import NDArray
from typing_extensions import Self

from recon.core.geometry.se3 import apply
from recon.core.kernels.voxels import distinct_keys, pack_keys, unpack_keys
from recon.core.progress import tracked
from recon.core.values import OccupancyVoxels
from recon.core.values.arrays import Bool, Float64, Int64, tree_of
from recon.map.builders import Submap
from recon.map.fusion import ALL, FusedPart, row_bytes
from recon.map.ground.grid import JOINED_CELLS, MIN_BLOB_CELLS
from recon.map.kernels.raycast import BLOCK_BITS, BLOCK_EDGE
from recon.map.occupancy.moving import GROWTH_CELLS
from recon.map.occupancy.part import OccupancyPart
from recon.map.settings import DriveSettings
from recon.map.store.records import Store

FUSED: Final = "fused"  # kind of the parts of the fused cloud in the tiles
OCCUPANCY: Final = "occupancy"  # kind of the parts of the occupancy
# Lengths are those on a road: they are times the scale of the scene.
_FILTER_MARGIN_M: Final = 1.0  # least margin around a tile for the filters of the fused cloud
_LEAST_TILE_M: Final = 5.0
_BLOCK_BYTES: Final = 4 * 3 * BLOCK_EDGE**3


@dataclass
class Cut:
    """Submaps cut into tiles: the ``frames`` of each, and the attributes ``known`` in all.

    ``corners`` are the lowest and highest (plus one) x and y of the cells that each observed;
    ``nbytes`` what joining the parts of a kind in a tile takes.
    """

    frames: list[int] = field(default_factory=list)
    known: set[str] = field(default_factory=lambda: set(ALL))
    corners: list[TileKey] = field(default_factory=list)
    nbytes: Counter[tuple[str, TileKey]] = field(default_factory=Counter)

    def add(self, submap: Submap) -> None:
        self.frames.append(submap.frames)
        self.known &= set(submap.fused.known if len(submap.fused) else ALL)
        columns = submap.occupancy.cells[:, :2]
        if len(columns):
            low, high = columns.min(axis=0).tolist(), (columns.max(axis=0) + 1).tolist()
            self.corners += [(low[0], low[1]), (high[0], high[1])]

    @property
    def extent(self) -> tuple[TileKey, TileKey]:
        """Smallest x and y of the cells that they observed, and the largest plus one."""
        x, y = zip(*(self.corners or [(0, 0)]), strict=True)
        return (min(x), min(y)), (max(x), max(y))

    def fits(self, limit: int | None) -> bool:
        """Return whether every tile can be joined within some bytes; None = no limit."""
        return limit is None or max(self.nbytes.values(), default=0) <= limit

    def submap_of_frame(self, drives: Sequence[int]) -> Int64:
        """Return int64 (N,), submap of each frame, -1 between drives of so many submaps each."""
        found = np.repeat(np.arange(len(self.frames)), self.frames)
        ends = np.searchsorted(found, np.cumsum(drives, dtype=np.int64)[:-1])
        return np.insert(found, ends, -1)

    def to_tree(self) -> dict[str, Any]:
        return {
            "frames": self.frames,
            "known": sorted(self.known),
            "corners": self.corners,
            "nbytes": [[kind, x, y, size] for (kind, (x, y)), size in self.nbytes.items()],
        }

    @classmethod
    def joined(cls, trees: Iterable[Mapping[str, Any]]) -> Cut:
        """Return the cut of all submaps, from the `to_tree` of their parts in order."""
        whole = cls()
        for tree in trees:
            whole.frames += tree["frames"]
            whole.known &= set(tree["known"])
            whole.corners += [(x, y) for x, y in tree["corners"]]
            whole.nbytes.update({(kind, (x, y)): size for kind, x, y, size in tree["nbytes"]})
        return whole


class Cutter:
    """Cuts submaps into tiles, each with the margin that its points and grid cells depend on.

    A tile is ``edge_cells`` voxels wide, a power of two, at least 8. ``limit_bytes`` is the largest
    size of a tile in memory; None = it cannot be smaller.
    """

    def __init__(self, config: DriveSettings, T_map_world: Float64, halvings: int = 0) -> None:
        self._config, self._T_map_world = config, T_map_world
        resolution_m = config.occupancy.resolution_m
        # A power of two, so that a tile is a branch of an octree.
        cells = round(math.log2(config.submaps.tile_m / resolution_m))
        self.edge_cells = 1 << max(BLOCK_BITS, cells - halvings)
        self.edge_m = self.edge_cells * resolution_m
        margin_m = (config.map_filters.radius_m or 0.0) * 2 ** (config.fusion.doublings or 0)
        margin_m = max(config.scale * _FILTER_MARGIN_M, margin_m)
        # A voxel more, since a point may lie anywhere in its voxel; and whether a point moved
        # depends on the points in the voxels that touch those through which it may have grown, at
        # the sides and then twice below.
        beyond = 5 + GROWTH_CELLS
        self._filter_margin_m = margin_m + config.fusion.voxel_m + beyond * resolution_m
        # A cell of a grid depends on the cells joined to it, on their blob, on as many around them,
        # and on adjacent cells; and a surface in a block on the blocks that touch it.
        beyond = MIN_BLOB_CELLS + 2 * JOINED_CELLS + 1 + BLOCK_EDGE
        beyond = max(beyond, math.ceil(self._filter_margin_m / resolution_m) + 1)
        # What the middle of a robot costs depends on what it is fitted to, half of its width away
        # from where its sides are. One wider than a tile, as on a table, has no costmap.
        if config.robot.width_m <= config.submaps.tile_m:
            beyond = max(beyond, math.ceil(config.robot.width_m / resolution_m) + 3)
        self.grid_margin_m = math.ceil(beyond / BLOCK_EDGE) * BLOCK_EDGE * resolution_m
        least_m = max(config.scale * _LEAST_TILE_M, margin_m, MIN_BLOB_CELLS * resolution_m)
        small = self.edge_m < 2 * least_m or self.edge_cells == BLOCK_EDGE
        self.limit_bytes = None if small else config.memory.tile_bytes

    def cut(
        self,
        submaps: Iterable[Submap],
        parts: TileParts,
        T_corrected_world: Float64 | None = None,
        *,
        first: int = 0,
    ) -> Cut:
        """Cut consecutive submaps; it ends early where a tile does not fit into memory.

        ``T_corrected_world`` is float64 (S, 4, 4), a rigid correction of each; ``first`` the number
        of the first one in its map.
        """
        cut = Cut()
        for place, submap in enumerate(tracked(submaps, "submaps", "cut into tiles")):
            moved, config = submap, self._config
            if T_corrected_world is not None and (T_corrected_world[place] != np.eye(4)).any():
                sizes_m = (config.fusion.voxel_m, config.occupancy.resolution_m)
                moved = submap.moved(T_corrected_world[place], self._T_map_world, *sizes_m)
            cut.add(moved)
            for kind, key, part, nbytes in self._pieces(moved, parts):
                parts.put(kind, key, tree_of(part), first + place)
                cut.nbytes[kind, key] += nbytes
            if not cut.fits(self.limit_bytes):
                break
            del submap, moved  # before the next one is read
        return cut

    def centres_m(self, part: OccupancyPart) -> Float64:
        """Return float64 (B, 3), centres of the blocks of a part."""
        return np.asarray((part.blocks + 0.5) * (BLOCK_EDGE * self._config.occupancy.resolution_m))

    def _pieces(
        self, submap: Submap, parts: TileParts
    ) -> Iterator[tuple[str, TileKey, FusedPart | OccupancyPart, int]]:
        """Yield a submap in pieces: kind, tile, content, and the bytes that joining it takes."""
        fused, occupancy, voxel_m = submap.fused, submap.occupancy, self._config.fusion.voxel_m
        centres_m = apply(self._T_map_world, (fused.cells + 0.5) * voxel_m)
        for key, inside in parts.near(centres_m, self._filter_margin_m):
            yield FUSED, key, fused.select(inside), int(inside.sum()) * row_bytes(fused.known)
        for key, inside in parts.near(self.centres_m(occupancy), self.grid_margin_m):
            yield OCCUPANCY, key, occupancy.select(inside), int(inside.sum()) * _BLOCK_BYTES


_NOTE: Final = "note"
TileKey = tuple[int, int]
"""Column and row of a tile; tile (0, 0) has its lower corner in the origin of the map."""


class TileParts:
    """Numbered parts of several kinds in each tile, in a file; others' files can be looked into.

    ``path`` is the file, which `save` makes readable for others; None = a temporary one.
    """

    def __init__(self, edge_m: float, path: Path | None = None) -> None:
        self.edge_m = edge_m
        self._store = Store.temporary() if path is None else Store.create(path)
        self._homes: dict[tuple[str, TileKey, int], Store] = {}
        self._numbers: dict[str, dict[TileKey, list[int]]] = defaultdict(dict)
        self._keys: dict[TileKey, None] = {}

    @property
    def keys(self) -> list[TileKey]:
        """The tiles in which there is something, in the order in which they were begun."""
        return list(self._keys)

    def bounds(self, key: TileKey) -> Rectangle:
        (x, y), edge_m = key, self.edge_m
        return Rectangle((x * edge_m, y * edge_m), ((x + 1) * edge_m, (y + 1) * edge_m))

    def near(
        self, places_m: NDArray[np.floating[Any]], margin_m: float
    ) -> Iterator[tuple[TileKey, Bool]]:
        """Yield the tiles that have places (N, 2 or 3) in them or their margin, and which ones."""
        home = np.floor(places_m[:, :2] / self.edge_m).astype(np.int64)
        # Packed into one integer, since numpy sorts rows slowly.
        homes = unpack_keys(distinct_keys(pack_keys(np.pad(home, ((0, 0), (0, 1))))))
        reach = math.ceil(margin_m / self.edge_m) or 1
        steps = range(-reach, reach + 1)
        found = {(x + i, y + j) for x, y, _ in homes.tolist() for i, j in product(steps, repeat=2)}
        for key in sorted(found):
            inside = self.bounds(key).wider(margin_m).contains(places_m)
            if inside.any():
                yield key, inside

    def under(self, rectangle: Rectangle) -> list[TileKey]:
        """Return the tiles that a rectangle touches and in which there is something."""
        low = np.floor(np.array(rectangle.low) / self.edge_m).astype(int).tolist()
        high = np.floor(np.array(rectangle.high) / self.edge_m).astype(int).tolist()
        columns, rows = (range(a, b + 1) for a, b in zip(low, high, strict=True))
        return [key for key in product(columns, rows) if key in self._keys]

    def numbers(self, kind: str, key: TileKey) -> Sequence[int]:
        """Return the numbers of the parts of a kind in a tile, in the order they were put."""
        return tuple(self._numbers[kind].get(key, ()))

    def put(
        self, kind: str, key: TileKey, tree: Mapping[str, Any], number: int | None = None
    ) -> None:
        """Keep a part, by default under the next number."""
        numbers = self._numbers[kind].setdefault(key, [])
        numbers.append(len(numbers) if number is None else number)
        self._store.put(kind, (*key, numbers[-1]), tree)
        self._keys[key] = None

    def read(self, kind: str, key: TileKey) -> Iterator[tuple[int, dict[str, Any]]]:
        """Yield the parts of a kind in a tile with their numbers; arrays are read-only."""
        # Past the cache: reading a tile again is faster than making it, and it may be large.
        return (
            (n, self._homes.get((kind, key, n), self._store).read(kind, (*key, n)))
            for n in self.numbers(kind, key)
        )

    def drop(self, kind: str, key: TileKey) -> None:
        """Forget the parts of a kind in a tile; they stay in the files of others."""
        for number in self._numbers[kind].pop(key, ()):
            if self._homes.pop((kind, key, number), None) is None:
                self._store.delete(kind, (*key, number))

    def save(self, note: Mapping[str, Any]) -> None:
        """Make the file readable for `adopt`, with a note, and close it."""
        self._store.put(_NOTE, 0, {"keys": self.keys, "note": note})
        self._store.commit()
        self._store.close()

    def adopt(self, path: Path) -> dict[str, Any]:
        """Add the parts in a file that was saved, which is not copied; return its note."""
        store = Store.open(path, read_only=True)
        saved = store.read(_NOTE, 0)
        self._keys.update(dict.fromkeys((x, y) for x, y in saved["keys"]))
        for kind in store.kinds():
            for x, y, number in (key for key in store.keys(kind) if isinstance(key, tuple)):
                self._numbers[kind].setdefault((x, y), []).append(number)
                self._homes[kind, (x, y), number] = store
        return dict(saved["note"])


@dataclass(frozen=True)
class Rectangle:
    """A rectangle of the map seen from above: smallest and largest x and y, metres."""

    low: tuple[float, float]
    high: tuple[float, float]

    def wider(self, margin_m: float) -> Self:
        (x0, y0), (x1, y1) = self.low, self.high
        return type(self)((x0 - margin_m, y0 - margin_m), (x1 + margin_m, y1 + margin_m))

    def contains(self, points: NDArray[np.floating]) -> Bool:
        """Return which points (N, 2 or 3) lie in the rectangle."""
        (x0, y0), (x1, y1), (x, y) = self.low, self.high, points.T[:2]
        return np.asarray((x >= x0) & (x < x1) & (y >= y0) & (y < y1))

    def voxels(self, voxels: OccupancyVoxels) -> OccupancyVoxels:
        """Return the voxels with their centres in the rectangle."""
        low, high = np.ceil(np.array((self.low, self.high)) / voxels.resolution_m - 0.5)
        x, y = voxels.keys[:, 0], voxels.keys[:, 1]
        inside: Bool = (x >= low[0]) & (x < high[0]) & (y >= low[1]) & (y < high[1])
        return voxels.select(inside)

    def path(self, path_m: Float64) -> Float64:
        """Return the pieces of a path (N, 3) inside, with a row of NaN after each that leaves."""
        inside = self.contains(path_m)
        leaves = np.r_[False, inside[:-1]] & ~inside
        return np.asarray(np.where(inside[:, None], path_m, np.nan)[inside | leaves])
