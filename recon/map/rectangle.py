"""Rectangles of a map seen from above."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from typing_extensions import Self

from recon.core.values import OccupancyVoxels
from recon.core.values.arrays import Bool, Float64


@dataclass(frozen=True)
class Rectangle:
    """A rectangle of the map.

    Attributes:
        low: Smallest x and y, metres.
        high: Largest x and y, metres.
    """

    low: tuple[float, float]
    high: tuple[float, float]

    def wider(self, margin_m: float) -> Self:
        """Return the rectangle with a margin around it."""
        (x0, y0), (x1, y1) = self.low, self.high
        return type(self)((x0 - margin_m, y0 - margin_m), (x1 + margin_m, y1 + margin_m))

    def contains(self, points: NDArray[np.floating]) -> NDArray[np.bool_]:
        """Return which points (N, 2 or 3) lie in the rectangle."""
        return np.asarray(((points[:, :2] >= self.low) & (points[:, :2] < self.high)).all(axis=1))

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
