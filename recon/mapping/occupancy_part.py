"""What a part of a drive does to the occupancy of space, to be followed by other parts."""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from recon.kernels import clamped, raycast, voxels
from recon.structures import OccupancyVoxels
from recon.structures.arrays import Float64, Int32


@dataclass(frozen=True, eq=False)
class OccupancyPart:
    """The cells that a part of a drive observed, and what it did to the log-odds of each.

    Attributes:
        rows: `recon.kernels.clamped.CellRows`, cells in map axes.
    """

    rows: clamped.CellRows

    def __len__(self) -> int:
        return len(self.rows.cells)

    @property
    def blocks(self) -> Int32:
        """int32 (B, 3), indices of the blocks of 8×8×8 cells."""
        return voxels.unpack_keys(self.rows.blocks)

    def select(self, which: NDArray[Any]) -> OccupancyPart:
        """The blocks of a boolean mask (B,)."""
        sizes = np.diff(self.rows.starts)
        cells = np.repeat(which, sizes)
        starts = np.concatenate([[0], np.cumsum(sizes[which])]).astype(np.int64)
        return OccupancyPart(
            clamped.CellRows(
                self.rows.blocks[which], starts, self.rows.cells[cells], self.rows.values[cells]
            )
        )

    def moved(self, T_new_map: Float64, resolution_m: float) -> OccupancyPart:
        """The part after a rigid motion: each cell takes what was at its centre before."""
        T_cells = T_new_map.copy()
        T_cells[:3, 3] /= resolution_m
        blocks = clamped.chain_rows(clamped.make_clamped(1), self.rows)
        moved = OccupancyPart(clamped.observed_rows(clamped.move_blocks(blocks, T_cells)))
        return moved.select(np.diff(moved.rows.starts) > 0)

    def voxels(self, resolution_m: float) -> OccupancyVoxels:
        """The log-odds of a drive that consists of this part alone."""
        edge = raycast.BLOCK_EDGE
        corner = np.repeat(self.blocks * edge, np.diff(self.rows.starts), axis=0)
        local = np.stack(np.unravel_index(self.rows.cells, (edge, edge, edge)), axis=1)
        change, low, high = self.rows.values.T
        return OccupancyVoxels(
            keys=(corner + local).astype(np.int32),
            log_odds=np.minimum(np.maximum(change, low), high),
            resolution_m=resolution_m,
        )


def join_occupancy(parts: Iterable[OccupancyPart]) -> OccupancyPart:
    """Parts that follow one another in time, as one."""
    blocks = clamped.make_clamped(1)
    for part in parts:
        blocks = clamped.chain_rows(blocks, part.rows)
    return OccupancyPart(clamped.observed_rows(blocks))
