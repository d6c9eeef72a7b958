"""Submaps cut into the square tiles of a map, and what is known of those that were cut."""

from __future__ import annotations

import math
from collections import Counter
from collections.abc import Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from typing import Any, Final

import numpy as np
from numpy.typing import NDArray

from recon.core.geometry.se3 import apply
from recon.core.values.arrays import Float64
from recon.map.fusion.part import KNOWABLE, FusedPart
from recon.map.ground.grid import JOINED_CELLS
from recon.map.kernels.raycast import BLOCK_BITS, BLOCK_EDGE
from recon.map.occupancy.moving import GROWTH_CELLS
from recon.map.occupancy.part import OccupancyPart
from recon.map.settings import DriveSettings
from recon.map.store.tile_parts import TileKey, TileParts
from recon.map.submaps import Submap

FUSED: Final = "fused"
"""Kind of the parts of the fused cloud in the tiles."""
OCCUPANCY: Final = "occupancy"
"""Kind of the parts of the occupancy."""
_FILTER_MARGIN_M: Final = 1.0
"""Least margin around a tile for the filters of the fused cloud."""
_LEAST_TILE_M: Final = 5.0
_FUSED_BYTES: Final = 60
_BLOCK_BYTES: Final = 4 * 3 * BLOCK_EDGE**3


@dataclass
class Cut:
    """Consecutive submaps that were cut into tiles.

    Attributes:
        frames: Number of frames of each.
        known: Attributes of points that all have.
        extent: Smallest x and y of the cells that they observed, and the largest plus one.
        nbytes: What joining the parts of a kind in a tile takes.
    """

    frames: list[int] = field(default_factory=list)
    known: set[str] = field(default_factory=lambda: set(KNOWABLE))
    extent: tuple[TileKey, TileKey] = ((0, 0), (0, 0))
    nbytes: Counter[tuple[str, TileKey]] = field(default_factory=Counter)

    def add(self, submap: Submap) -> None:
        """Add the next submap, where it was put."""
        self.frames.append(submap.frames)
        self.known &= set(submap.fused.known if len(submap.fused) else KNOWABLE)
        self.extent = _hull(self.extent, _extent(submap.occupancy))

    def fits(self, limit: int | None) -> bool:
        """Return whether every tile can be joined within some bytes; None = no limit."""
        return limit is None or max(self.nbytes.values(), default=0) <= limit

    def submap_of_frame(self, drives: Sequence[int]) -> NDArray[np.int64]:
        """Return int64 (N,), number of the submap of each frame; -1 between two drives.

        Args:
            drives: Number of submaps of each drive; empty = all are of one.
        """
        found = np.repeat(np.arange(len(self.frames)), self.frames)
        ends = np.searchsorted(found, np.cumsum(drives, dtype=np.int64)[:-1])
        return np.insert(found, ends, -1)

    def to_tree(self) -> dict[str, Any]:
        """Return everything, as a tree of plain values."""
        return {
            "frames": self.frames,
            "known": sorted(self.known),
            "extent": self.extent,
            "nbytes": [[kind, x, y, size] for (kind, (x, y)), size in self.nbytes.items()],
        }

    @classmethod
    def joined(cls, trees: Iterable[Mapping[str, Any]]) -> Cut:
        """Return the cut of all submaps, from what `to_tree` gave of their parts in order."""
        whole = cls()
        for tree in trees:
            (x0, y0), (x1, y1) = tree["extent"]
            whole.frames += tree["frames"]
            whole.known &= set(tree["known"])
            whole.extent = _hull(whole.extent, ((x0, y0), (x1, y1)))
            whole.nbytes.update({(kind, (x, y)): size for kind, x, y, size in tree["nbytes"]})
        return whole


class Cutter:
    """Cuts submaps into tiles, each with the margin that its points and grid cells depend on.

    Args:
        config: The configuration.
        T_map_world: float64 (4, 4), from world to map axes.
        halvings: How often the tiles of the configuration are halved.

    Attributes:
        edge_cells: Side of a tile in voxels; a power of two, at least 8.
        edge_m: Side of a tile.
        grid_margin_m: Margin of the occupancy.
        limit_bytes: Largest size of a tile in memory, if it could be smaller.
    """

    def __init__(self, config: DriveSettings, T_map_world: Float64, halvings: int = 0) -> None:
        self._config, self._T_map_world = config, T_map_world
        resolution_m, filters = config.occupancy.resolution_m, config.map_filters
        # A power of two, so that a tile is a branch of an octree.
        cells = round(math.log2(config.submaps.tile_m / resolution_m))
        self.edge_cells = 1 << max(BLOCK_BITS, cells - halvings)
        self.edge_m = self.edge_cells * resolution_m
        margin_m = max(_FILTER_MARGIN_M, 2 * (filters.voxel_m or 0.0), filters.radius_m or 0.0)
        # A voxel more, since a point may lie anywhere in its voxel; and whether a point moved
        # depends on the points in the voxels that touch those through which it may have grown.
        beyond = 3 + GROWTH_CELLS
        self._filter_margin_m = margin_m + config.fusion.voxel_m + beyond * resolution_m
        # A cell of a grid depends on the cells joined to it, on their blob, and on adjacent cells.
        beyond = config.grid.min_blob_cells + JOINED_CELLS + 2
        beyond = max(beyond, math.ceil(self._filter_margin_m / resolution_m) + 1)
        self.grid_margin_m = math.ceil(beyond / BLOCK_EDGE) * BLOCK_EDGE * resolution_m
        least_m = max(_LEAST_TILE_M, margin_m, config.grid.min_blob_cells * resolution_m)
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
        """Cut submaps; it ends early where a tile does not fit into memory.

        Args:
            submaps: Consecutive submaps.
            parts: Where the pieces go.
            T_corrected_world: float64 (S, 4, 4), a rigid correction of each; None = none.
            first: Number of the first one in its map.
        """
        cut = Cut()
        for place, submap in enumerate(submaps):
            T = None if T_corrected_world is None else T_corrected_world[place]
            moved = self._moved(submap, T)
            cut.add(moved)
            for kind, key, part, nbytes in self._pieces(moved, parts):
                parts.put(kind, key, part.to_tree(), first + place)
                cut.nbytes[kind, key] += nbytes
            if not cut.fits(self.limit_bytes):
                break
            del submap, moved  # before the next one is read
        return cut

    def centres_m(self, part: OccupancyPart) -> Float64:
        """Return float64 (B, 3), centres of the blocks of a part."""
        return np.asarray((part.blocks + 0.5) * (BLOCK_EDGE * self._config.occupancy.resolution_m))

    def _moved(self, submap: Submap, T_corrected_world: Float64 | None) -> Submap:
        """Return a submap with its correction applied."""
        if T_corrected_world is None or np.array_equal(T_corrected_world, np.eye(4)):
            return submap
        config = self._config
        sizes_m = (config.fusion.voxel_m, config.occupancy.resolution_m)
        return submap.moved(T_corrected_world, self._T_map_world, *sizes_m)

    def _pieces(
        self, submap: Submap, parts: TileParts
    ) -> Iterator[tuple[str, TileKey, FusedPart | OccupancyPart, int]]:
        """Yield a submap in pieces: kind, tile, content, and the bytes that joining it takes."""
        fused, occupancy, voxel_m = submap.fused, submap.occupancy, self._config.fusion.voxel_m
        centres_m = apply(self._T_map_world, (fused.cells + 0.5) * voxel_m)
        for key, inside in parts.near(centres_m, self._filter_margin_m):
            yield FUSED, key, fused.select(inside), int(inside.sum()) * _FUSED_BYTES
        for key, inside in parts.near(self.centres_m(occupancy), self.grid_margin_m):
            yield OCCUPANCY, key, occupancy.select(inside), int(inside.sum()) * _BLOCK_BYTES


def _extent(part: OccupancyPart) -> tuple[TileKey, TileKey]:
    """Return the extent of the cells of a part; empty if it has none."""
    columns = part.cells[:, :2]
    if not len(columns):
        return (0, 0), (0, 0)
    (x0, y0), (x1, y1) = columns.min(axis=0).tolist(), (columns.max(axis=0) + 1).tolist()
    return (x0, y0), (x1, y1)


def _hull(one: tuple[TileKey, TileKey], other: tuple[TileKey, TileKey]) -> tuple[TileKey, TileKey]:
    """Return the extent of two; one that is empty does not count."""
    if one[0] == one[1] or other[0] == other[1]:
        return one if other[0] == other[1] else other
    (a, b), (c, d) = one
    (e, f), (g, h) = other
    return (min(a, e), min(b, f)), (max(c, g), max(d, h))
