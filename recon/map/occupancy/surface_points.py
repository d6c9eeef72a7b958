"""Mean position of the hits in each cell, which tells in which of two cells a surface is."""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from recon.core.errors import FormatError
from recon.core.geometry.se3 import apply
from recon.core.kernels import voxels
from recon.core.kernels.voxels import are_among
from recon.core.values.arrays import Bool, Float32, Float64, Int32, array_in
from recon.map.kernels import facets
from recon.map.kernels.raycast import BLOCK_BITS


@dataclass(frozen=True, eq=False)
class SurfacePoints:
    """Sums per cell over the hits of all frames, in the order in which cells were first hit.

    Attributes:
        keys: int64 (N,), packed cells in map axes (`recon.core.kernels.voxels`), each once.
        sums: float32 (N, 4), sum of weights, and weighted sums of the offset from the centre of
            the cell, in cells.
    """

    keys: NDArray[np.int64]
    sums: Float32

    def __len__(self) -> int:
        return len(self.keys)

    @classmethod
    def from_tree(cls, tree: Mapping[str, Any]) -> SurfacePoints:
        """Return the points in a tree of their arrays."""
        keys = array_in(tree, "keys", np.int64, (None,))
        sums = array_in(tree, "sums", np.float32, (len(keys), 4))
        if keys.min(initial=0) < 0 or sums[:, 0].min(initial=1) <= 0:
            raise FormatError("a submap of the map has an impossible hit")
        return cls(keys, sums)

    def select(self, which: NDArray[Any]) -> SurfacePoints:
        """Return the rows of a boolean mask or of an index array, in that order."""
        return SurfacePoints(self.keys[which], self.sums[which])

    def in_blocks(self, blocks: NDArray[np.int64]) -> SurfacePoints:
        """Return the cells that lie in some packed blocks."""
        home = voxels.pack_keys(voxels.unpack_keys(self.keys) >> BLOCK_BITS)
        return self.select(are_among(home, blocks))

    def moved(self, T_new_map: Float64) -> SurfacePoints:
        """Return the sums after a rigid motion: those of a cell go to that of its moved mean point.

        Args:
            T_new_map: float64 (4, 4), its translation in cells.
        """
        weight = self.sums[:, :1]
        centres = voxels.unpack_keys(self.keys) + 0.5
        places = apply(T_new_map, centres + self.sums[:, 1:] / weight)
        cells = np.floor(places).astype(np.int64)
        sums = np.concatenate([weight, weight * (places - cells - 0.5)], axis=1)
        return join_points([SurfacePoints(voxels.pack_keys(cells), sums.astype(np.float32))])

    def cross(self, cells: Int32) -> Bool:
        """Return bool (N,): cells (N, 3) that the surface through points around them crosses."""
        return facets.crossed_cells(cells, self.keys, self.sums)


def join_points(parts: Iterable[SurfacePoints]) -> SurfacePoints:
    """Return points of different frames as those of one drive."""
    return points_of(sum_points(parts))


def sum_points(parts: Iterable[SurfacePoints]) -> voxels.VoxelSums:
    """Return sums to which more can be added, in cells of edge 1."""
    total = voxels.make_sums(1, 0)
    for part in parts:
        none = np.zeros(len(part), np.float32)
        total = voxels.add_rows(total, part.keys, part.sums, none, none.astype(np.int32))
    return total


def points_of(total: voxels.VoxelSums) -> SurfacePoints:
    """Return a copy of what was summed up."""
    n = int(total.used[0])
    return SurfacePoints(total.keys[:n].copy(), total.sums[:n].copy())
