"""The occupancy that several drives observed in a tile: a later drive counts more."""

from __future__ import annotations

from collections.abc import Iterable, Iterator, Mapping
from functools import reduce
from heapq import merge
from itertools import groupby, product
from operator import itemgetter
from typing import Any, Final

import numpy as np
from numpy.typing import NDArray

from recon.core.kernels.voxels import are_among, distinct_keys, pack_keys, unpack_keys
from recon.core.values import OccupancyVoxels, join_voxels
from recon.core.values.grid import log_odds
from recon.map.cut import OCCUPANCY
from recon.map.kernels.raycast import BLOCK_BITS
from recon.map.occupancy.moving import CellEvidence, cell_evidence
from recon.map.occupancy.part import OccupancyPart, join_occupancy
from recon.map.store.tile_parts import TileKey, TileParts

_EVIDENCE: Final = "evidence"
_OLD: Final = log_odds(0.85)
"""Most log-odds that earlier drives keep: five rays of a later one free what was occupied."""


class DriveChain:
    """Chains the occupancy of the submaps in a tile.

    Args:
        parts: What the submaps observed in the tiles, numbered by submap.

    Attributes:
        drive_of: int64 (S,), the drive of each submap; empty = all are of one.
    """

    def __init__(self, parts: TileParts) -> None:
        self._parts = parts
        self.drive_of: NDArray[np.int64] = np.zeros(0, np.int64)

    def drive(self, numbered: tuple[int, Any]) -> int:
        """Return the drive of what is numbered by submap."""
        return int(self.drive_of[numbered[0]]) if len(self.drive_of) else 0

    def joined(self, key: TileKey, *, note: bool) -> OccupancyPart:
        """Join what all drives observed in a tile; ``note`` what each saw, for `evidence`."""
        drives = self._drives(key)
        return _outdone(self._noted(key, drives) if note else (part for _, part in drives))

    def evidence(self, key: TileKey, drive: int) -> CellEvidence:
        """Return the `cell_evidence` of a drive that was noted in a tile."""
        for number, tree in self._parts.read(_EVIDENCE, key):
            if number == drive:
                return tree["cells"], tree["log_odds"]
        return np.zeros(0, np.int64), np.zeros(0, np.float32)

    def changed(
        self, key: TileKey, seen: OccupancyVoxels, after: Mapping[int, OccupancyPart]
    ) -> OccupancyVoxels:
        """Make the voxels of a tile again where ``after`` the end of submaps more was observed."""
        blocks = distinct_keys(np.concatenate([part.rows.blocks for part in after.values()]))
        # Whether a surface crosses a voxel depends on what hit those that touch it.
        changed, needed = _grown(blocks, 1), _grown(blocks, 2)
        joined = _outdone(part for _, part in self._drives(key, after, needed))
        anew = joined.voxels(seen.resolution_m)
        return join_voxels(
            [
                seen.select(~are_among(pack_keys(seen.keys >> BLOCK_BITS), changed)),
                anew.select(are_among(pack_keys(anew.keys >> BLOCK_BITS), changed)),
            ],
            seen.resolution_m,
        )

    def _noted(
        self, key: TileKey, drives: Iterable[tuple[int, OccupancyPart]]
    ) -> Iterator[OccupancyPart]:
        """Return the parts of drives, with a note of what each saw."""
        for drive, part in drives:
            cells, seen = cell_evidence(part)
            self._parts.put(_EVIDENCE, key, {"cells": cells, "log_odds": seen}, drive)
            yield part

    def _drives(
        self,
        key: TileKey,
        after: Mapping[int, OccupancyPart] | None = None,
        blocks: NDArray[np.int64] | None = None,
    ) -> Iterator[tuple[int, OccupancyPart]]:
        """Return what each drive observed in a tile, in their order.

        Args:
            key: The tile.
            after: What else was observed at the end of submaps, by their numbers.
            blocks: Packed blocks to look at; None = all.
        """
        own = ((n, OccupancyPart.from_tree(tree)) for n, tree in self._parts.read(OCCUPANCY, key))
        # Of one number, that of the submap comes first.
        numbered = merge(own, sorted((after or {}).items()), key=itemgetter(0))
        for drive, parts in groupby(numbered, key=self.drive):
            # Joined one by one, so that a place passed often takes no more memory than others.
            yield drive, join_occupancy(_in_blocks(part, blocks) for _, part in parts)


def _in_blocks(part: OccupancyPart, blocks: NDArray[np.int64] | None) -> OccupancyPart:
    return part if blocks is None else part.select(are_among(part.rows.blocks, blocks))


def _outdone(drives: Iterable[OccupancyPart]) -> OccupancyPart:
    """Chain what drives observed; little of the older counts for a later one."""
    return reduce(lambda old, new: join_occupancy([old, new.outdoing(_OLD)]), drives)


def _grown(blocks: NDArray[np.int64], by: int) -> NDArray[np.int64]:
    """Return packed blocks with those up to ``by`` blocks away from one on each axis."""
    steps = np.array(list(product(range(-by, by + 1), repeat=3)))
    around = unpack_keys(blocks)[:, None] + steps
    return distinct_keys(pack_keys(around.reshape(-1, 3)))
