"""What is known of submaps that were cut into tiles, beside the parts in the tiles."""

from __future__ import annotations

from collections import Counter
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, field
from typing import Any

import numpy as np
from numpy.typing import NDArray

from recon.map.fusion.part import KNOWABLE
from recon.map.occupancy.part import OccupancyPart
from recon.map.store.tile_parts import TileKey
from recon.map.submaps import Submap


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
