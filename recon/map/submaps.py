"""Submaps: consecutive frames with their part of the fused cloud and of the occupancy.

A submap is built in the world of the odometry. Where loop closure moves it, its voxels are moved
with it, and nothing is matched again; without corrections the submaps together are one long drive.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import Any

from recon.core.geometry.se3 import invert
from recon.core.settings import Length, Settings
from recon.core.values.arrays import Float64
from recon.map.fusion import FusedPart
from recon.map.occupancy.part import OccupancyPart


class SubmapSettings(Settings):
    """Where a drive is divided into submaps, and into which tiles its map.

    Both bound the memory. Apart from rounding they change no result, except where a vehicle turned
    back and saw something on its own track: whether that came later is known by submaps.
    """

    length_m: float = Length(25.0, ge=1e-06, le=100_000.0)
    """Path after which a new submap begins. Shorter ones follow closed loops better and take
    less memory."""
    tile_m: float = Length(50.0, ge=1e-06, le=100_000.0)
    """Edge of the tiles, rounded to whole voxels. Smaller ones take less memory, and more time."""


@dataclass(frozen=True, eq=False)
class Submap:
    """What consecutive frames saw: ``fused`` in world axes, ``occupancy`` in map axes."""

    index: int
    first_frame: int
    frames: int
    fused: FusedPart
    occupancy: OccupancyPart

    def moved(
        self, T_corrected_world: Float64, T_map_world: Float64, voxel_m: float, resolution_m: float
    ) -> Submap:
        """Return the submap after a correction of its pose."""
        T_corrected_map = T_map_world @ T_corrected_world @ invert(T_map_world)
        return replace(
            self,
            fused=self.fused.moved(T_corrected_world, voxel_m),
            occupancy=self.occupancy.moved(T_corrected_map, resolution_m),
        )

    @classmethod
    def from_tree(cls, tree: dict[str, Any]) -> Submap:
        """Return the submap that a tree (`tree_of`) is of."""
        return cls(
            tree["index"],
            tree["first_frame"],
            tree["frames"],
            FusedPart.from_tree(tree["fused"]),
            OccupancyPart.from_tree(tree["occupancy"]),
        )
