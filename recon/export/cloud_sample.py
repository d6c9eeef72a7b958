"""An even sample of a cloud that is too large for memory, for images and reports."""

from __future__ import annotations

from typing import Final

import numpy as np
from numpy.typing import NDArray

from recon.core.kernels import voxels
from recon.core.values import PointCloud
from recon.map.drive_map import join_clouds

_GROWTH: Final = 1.25


class CloudSample:
    """Keeps the first point of each grid cell; cells grow as points are added.

    Args:
        limit: Largest number of points kept; up to it, all are kept.
        cell_m: Cell size when the limit is first reached.
    """

    def __init__(self, limit: int, cell_m: float) -> None:
        self._limit = limit
        self._first_cell_m = cell_m
        self._cell_m: float | None = None
        self._kept: list[PointCloud] = []

    def add(self, cloud: PointCloud) -> None:
        """Add points; all clouds are in one frame and have the same fields."""
        self._kept.append(self._thinned(cloud))
        if sum(map(len, self._kept)) > self._limit:
            whole = join_clouds(self._kept)
            self._kept = [] if whole is None else [self._within_the_limit(whole)]

    def cloud(self) -> PointCloud | None:
        """The sample; None if nothing was added."""
        return join_clouds(self._kept)

    def _within_the_limit(self, cloud: PointCloud) -> PointCloud:
        """Thin a cloud, with growing cells, until it is within the limit."""
        self._cell_m = self._cell_m or self._first_cell_m
        thinned = self._thinned(cloud)
        while len(thinned) > self._limit:
            self._cell_m *= _GROWTH
            thinned = self._thinned(thinned)
        return thinned

    def _thinned(self, cloud: PointCloud) -> PointCloud:
        return cloud if self._cell_m is None else cloud.select(_first_of_cells(cloud, self._cell_m))


def _first_of_cells(cloud: PointCloud, cell_m: float) -> NDArray[np.intp]:
    """Indices of the first point in each cell, in order."""
    keys = voxels.pack_keys(np.floor(cloud.xyz / cell_m).astype(np.int64))
    return np.sort(np.unique(keys, return_index=True)[1])
