"""Occupancy maps: sparse 3-D voxels, and the 2-D grid used for path planning."""

from __future__ import annotations

import math
from collections.abc import Iterable
from dataclasses import dataclass
from typing import Final

import numpy as np
from numpy.typing import NDArray

from recon.core.lazy import Shown
from recon.core.text import counted
from recon.core.values.arrays import Bool, Float32, Float64, Int32, freeze, size_text

FREE: Final = 0
OCCUPIED: Final = 100
UNKNOWN: Final = -1


def log_odds(probability: float) -> float:
    """Return ``ln(p / (1 - p))``: independent evidence adds up."""
    return math.log(probability / (1.0 - probability))


@dataclass(frozen=True, eq=False)
class OccupancyVoxels:
    """The observed voxels of a 3-D map; voxels that are not listed are unknown.

    ``keys`` is int32 (N, 3): voxel ``k`` spans ``[k, k + 1) · resolution_m`` on each axis of the
    map; ``log_odds`` is float32 (N,), natural logarithm, above 0 = occupied.
    """

    keys: Int32
    log_odds: Float32
    resolution_m: float

    def __post_init__(self) -> None:
        freeze(self, "keys", np.int32, (None, 3))
        freeze(self, "log_odds", np.float32, (len(self.keys),))

    def __repr__(self) -> str:
        occupied = int(np.sum(self.log_odds > 0))
        sizes = f"{counted(len(self), 'voxel')} of {self.resolution_m:g} m, {occupied} occupied"
        return f"OccupancyVoxels({sizes})"

    def __len__(self) -> int:
        return len(self.keys)

    def select(self, which: Bool) -> OccupancyVoxels:
        return OccupancyVoxels(self.keys[which], self.log_odds[which], self.resolution_m)

    @property
    def centres_m(self) -> Float64:
        """float64 (N, 3), centres of the voxels, map axes."""
        return (self.keys.astype(np.float64) + 0.5) * self.resolution_m


def join_voxels(parts: Iterable[OccupancyVoxels], resolution_m: float) -> OccupancyVoxels:
    """Concatenate voxels of one resolution; none is in two parts."""
    keys, log_odds = [np.zeros((0, 3), np.int32)], [np.zeros(0, np.float32)]
    for part in parts:
        keys.append(part.keys)
        log_odds.append(part.log_odds)
    return OccupancyVoxels(np.concatenate(keys), np.concatenate(log_odds), resolution_m)


@dataclass(frozen=True, eq=False)
class OccupancyGrid(Shown):
    """A 2-D occupancy grid in map axes, with the conventions of ROS.

    ``cells`` is int8 (rows, columns) of FREE, OCCUPIED or UNKNOWN, from the smallest y and x on;
    ``origin_m`` is (x, y) of the outer corner of cell (0, 0).
    """

    cells: NDArray[np.int8]
    resolution_m: float
    origin_m: tuple[float, float]

    def __post_init__(self) -> None:
        freeze(self, "cells", np.int8, (None, None))

    def __repr__(self) -> str:
        named = (("occupied", OCCUPIED), ("free", FREE))
        ratios = [f"{100 * np.mean(self.cells == cell):.1f} % {name}" for name, cell in named]
        size = f"{size_text(self.cells)} cells of {self.resolution_m:g} m"
        return f"OccupancyGrid({size}, {', '.join(ratios)}, origin {self.origin_m} m)"
