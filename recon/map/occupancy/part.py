"""The occupancy that one submap saw, to be chained with that of others.

The mean position of the hits in each cell decides in which of two cells a surface is.
"""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from dataclasses import dataclass, replace
from typing import Any, Final

import numpy as np
from numpy.typing import NDArray

from recon.core.errors import FormatError
from recon.core.geometry.se3 import apply
from recon.core.kernels import voxels
from recon.core.kernels.voxels import are_among
from recon.core.values import OccupancyVoxels
from recon.core.values.arrays import Float32, Float64, Int32, Int64, array_in, frozen_array
from recon.map.kernels import clamped, facets, raycast
from recon.map.kernels.raycast import BLOCK_BITS

_UNSURE: Final = np.float32(0.01)
"""Log-odds of a voxel that was hit though the surface is likely in another: just above even."""


@dataclass(frozen=True, eq=False)
class OccupancyPart:
    """The cells that a part of a drive observed, and what it did to the log-odds of each; map axes.

    ``points`` is where its hits lie; None = not kept, surfaces are as thick as they were hit.
    """

    rows: clamped.CellRows
    points: SurfacePoints | None = None

    def __len__(self) -> int:
        return len(self.rows.cells)

    @property
    def blocks(self) -> Int32:
        """int32 (B, 3), indices of the blocks of 8×8×8 cells."""
        return voxels.unpack_keys(self.rows.blocks)

    @property
    def cells(self) -> Int32:
        """int32 (N, 3), indices of the observed cells."""
        edge = raycast.BLOCK_EDGE
        corner = np.repeat(self.blocks * edge, np.diff(self.rows.starts), axis=0)
        local = np.stack(np.unravel_index(self.rows.cells, (edge, edge, edge)), axis=1)
        return (corner + local).astype(np.int32)

    def select(self, which: NDArray[Any]) -> OccupancyPart:
        """Return the blocks of a boolean mask (B,)."""
        sizes = np.diff(self.rows.starts)
        cells = np.repeat(which, sizes)
        starts = np.concatenate([[0], np.cumsum(sizes[which])]).astype(np.int64)
        blocks, points = self.rows.blocks[which], self.points
        if points is not None:
            home = voxels.pack_keys(voxels.unpack_keys(points.keys) >> BLOCK_BITS)
            points = points.select(are_among(home, blocks))
        rows = clamped.CellRows(blocks, starts, self.rows.cells[cells], self.rows.values[cells])
        return OccupancyPart(rows, points)

    @classmethod
    def from_tree(cls, tree: Mapping[str, Any]) -> OccupancyPart:
        """Return the part that a tree (`tree_of`) is of."""
        rows, points = tree["rows"], tree["points"]
        blocks = array_in(rows, "blocks", np.int64, (None,))
        starts = array_in(rows, "starts", np.int64, (len(blocks) + 1,))
        cells = array_in(rows, "cells", np.uint16, (None,))
        values = frozen_array("values", rows["values"], np.float32, (len(cells), 3))
        # Compiled loops will trust them.
        whole = (starts[0], starts[-1]) == (0, len(cells)) and (np.diff(starts) >= 0).all()
        inside = blocks.min(initial=0) >= 0 and cells.max(initial=0) < raycast.BLOCK_CELLS
        if not (whole and inside) or np.isnan(values).any():
            raise FormatError("a submap of the map has an impossible cell")
        found = clamped.CellRows(blocks, starts, cells, rows["values"])
        return cls(found, None if points is None else SurfacePoints.from_tree(points))

    def moved(self, T_new_map: Float64, resolution_m: float) -> OccupancyPart:
        """Return the part after a rigid motion: a cell gets the values that were at its centre."""
        T_cells = T_new_map.copy()
        T_cells[:3, 3] /= resolution_m
        blocks = clamped.chain_rows(clamped.make_clamped(1), self.rows)
        moved = OccupancyPart(
            clamped.observed_rows(clamped.move_blocks(blocks, T_cells)),
            None if self.points is None else self.points.moved(T_cells),
        )
        return moved.select(np.diff(moved.rows.starts) > 0)

    def outdoing(self, most: float) -> OccupancyPart:
        """Return the part of a later drive, before which log-odds count as ``most`` at the most."""
        change, low, high = self.rows.values.T
        # x -> min(max(x + change, low), high) after x -> min(max(x, -most), most).
        ends = [np.clip(change + end, low, high) for end in (-most, most)]
        values = np.stack([change, *ends], axis=1).astype(np.float32)
        return replace(self, rows=self.rows._replace(values=values))

    def voxels(self, resolution_m: float, blocks: Int64 | None = None) -> OccupancyVoxels:
        """Return the log-odds of a drive that consists of this part alone.

        A voxel that was hit is undecided unless the surface of the points around it crosses it: the
        surface is then in the voxel before or behind. Only those of packed ``blocks``, ascending,
        are returned; None = all.
        """
        change, low, high = self.rows.values.T
        cells, log_odds = self.cells, np.minimum(np.maximum(change, low), high)
        wanted = np.ones(len(cells), np.bool_)
        if blocks is not None:
            wanted = np.repeat(are_among(self.rows.blocks, blocks), np.diff(self.rows.starts))
        if self.points is not None:
            hit = log_odds > _UNSURE
            # What was hit and then looked through is no surface: a car that drove off, an outlier.
            among = are_among(self.points.keys, voxels.pack_keys(cells[hit]))
            points, rows = self.points.select(among), np.flatnonzero(hit & wanted)
            crossed = facets.crossed_cells(cells[rows], points.keys, points.sums)
            log_odds[rows[~crossed]] = _UNSURE
        return OccupancyVoxels(cells, log_odds, resolution_m).select(wanted)


def join_occupancy(parts: Iterable[OccupancyPart]) -> OccupancyPart:
    """Return parts that follow one another in time, chained."""
    blocks, points = clamped.make_clamped(1), []
    for part in parts:
        blocks = clamped.chain_rows(blocks, part.rows)
        points.append(part.points)
    known = [part for part in points if part is not None]
    joined = join_points(known) if known and len(known) == len(points) else None
    return OccupancyPart(clamped.observed_rows(blocks), joined)


def free_part(keys: Int32, log_odds: float) -> OccupancyPart:
    """Return a part after which cells (N, 3), each once, have given log-odds in any case."""
    home = voxels.pack_keys(keys >> raycast.BLOCK_BITS)
    order = np.argsort(home, kind="stable")
    blocks, starts = np.unique(home[order], return_index=True)
    edge = raycast.BLOCK_EDGE
    cells = np.ravel_multi_index(tuple((keys[order] % edge).T), (edge, edge, edge))
    rows = clamped.CellRows(
        blocks,
        np.append(starts, len(keys)).astype(np.int64),
        cells.astype(np.uint16),
        # x -> min(max(x + 0, low), high) with low = high.
        np.tile(np.array([0.0, log_odds, log_odds], np.float32), (len(keys), 1)),
    )
    nothing = SurfacePoints(np.zeros(0, np.int64), np.zeros((0, 5), np.float32))
    return OccupancyPart(rows, nothing)


@dataclass(frozen=True, eq=False)
class SurfacePoints:
    """Sums per cell over the hits of all frames, in the order in which cells were first hit."""

    # int64 (N,), packed cells in map axes (`recon.core.kernels.voxels`), each once
    keys: Int64
    # float32 (N, 5), sum of weights, and weighted sums of the offset from the centre of the cell,
    # in cells, and of the variance along the ray
    sums: Float32

    def __len__(self) -> int:
        return len(self.keys)

    @classmethod
    def from_tree(cls, tree: Mapping[str, Any]) -> SurfacePoints:
        keys = array_in(tree, "keys", np.int64, (None,))
        sums = array_in(tree, "sums", np.float32, (len(keys), 5))
        if keys.min(initial=0) < 0 or sums[:, ::4].min(initial=1) <= 0:
            raise FormatError("a submap of the map has an impossible hit")
        return cls(keys, sums)

    def select(self, which: NDArray[Any]) -> SurfacePoints:
        """Return the rows of a boolean mask or of an index array, in that order."""
        return SurfacePoints(self.keys[which], self.sums[which])

    def moved(self, T_new_map: Float64) -> SurfacePoints:
        """Return the sums after a rigid motion in cells; a cell moves as its mean point does."""
        weight = self.sums[:, :1]
        centres = voxels.unpack_keys(self.keys) + 0.5
        places = apply(T_new_map, centres + self.sums[:, 1:4] / weight)
        cells = np.floor(places).astype(np.int64)
        sums = np.concatenate([weight, weight * (places - cells - 0.5), self.sums[:, 4:]], axis=1)
        return join_points([SurfacePoints(voxels.pack_keys(cells), sums.astype(np.float32))])


def join_points(parts: Iterable[SurfacePoints]) -> SurfacePoints:
    """Return points of different frames as those of one drive."""
    return SurfacePoints(*voxels.copy_sums(sum_points(parts)))


def sum_points(parts: Iterable[SurfacePoints]) -> voxels.VoxelSums:
    """Return sums to which more can be added, in cells of edge 1."""
    total = voxels.make_sums(1, 1)
    for part in parts:
        none = np.zeros(len(part), np.float32)
        total = voxels.add_rows(total, part.keys, part.sums, none, none.astype(np.int32))
    return total
