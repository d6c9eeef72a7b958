"""Submaps: consecutive frames with their part of the fused cloud and of the occupancy.

A submap is built in the world of the odometry. Where loop closure moves it, its voxels are moved
with it, and nothing is matched again; without corrections the submaps together are one long drive.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import Any, Final

import numpy as np
from pydantic import Field

from recon.core.geometry.se3 import invert
from recon.core.settings import Settings
from recon.core.values import PointCloud
from recon.core.values.arrays import Float64
from recon.map.fusion import CloudBuilder, FusedPart, FusionSettings
from recon.map.occupancy.builder import OccupancyBuilder, OccupancySettings
from recon.map.occupancy.part import OccupancyPart

_MAX_FRAMES: Final = 100
"""Frames after which a new submap begins at the latest, however slow the drive."""


class SubmapSettings(Settings):
    """Where a drive is divided into submaps, and into which tiles its map.

    Both bound the memory. Apart from rounding they change no result, except where a vehicle turned
    back and saw something on its own track: whether that came later is known by submaps.
    """

    length_m: float = Field(25.0, ge=0.1, le=10_000.0)
    """Path after which a new submap begins. Shorter ones bend better with closed loops and take
    less memory."""
    tile_m: float = Field(50.0, ge=5.0, le=10_000.0)
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

    def to_tree(self) -> dict[str, Any]:
        """Return all of it as a tree of arrays and plain values."""
        return {
            "index": self.index,
            "first_frame": self.first_frame,
            "frames": self.frames,
            "fused": self.fused.to_tree(),
            "occupancy": self.occupancy.to_tree(),
        }

    @classmethod
    def from_tree(cls, tree: dict[str, Any]) -> Submap:
        """Return what `to_tree` gave."""
        return cls(
            tree["index"],
            tree["first_frame"],
            tree["frames"],
            FusedPart.from_tree(tree["fused"]),
            OccupancyPart.from_tree(tree["occupancy"]),
        )


class SubmapBuilder:
    """Builds the submaps of a drive, one after the other.

    At ``max_bytes`` a new submap begins; None = no limit.
    """

    def __init__(
        self,
        settings: SubmapSettings,
        fusion: FusionSettings,
        occupancy: OccupancySettings,
        T_map_world: Float64,
        max_bytes: int | None = None,
    ) -> None:
        self._settings = settings
        self._max_bytes = max_bytes
        self._fused = CloudBuilder(fusion)
        self._occupancy = OccupancyBuilder(occupancy, T_map_world)
        self._index = 0
        self._first_frame = 0
        self._frames = 0
        self._path_m = 0.0
        self._last_m: Float64 | None = None

    @property
    def frames(self) -> int:
        """Number of frames in the submap so far."""
        return self._frames

    def integrate(
        self, cloud_world: PointCloud, cloud_camera: PointCloud, T_world_camera: Float64
    ) -> None:
        """Add a frame: ``cloud_world`` is fused, ``cloud_camera`` occupies and frees space."""
        self._fused.integrate(cloud_world)
        self._occupancy.integrate(cloud_camera, T_world_camera)
        place = T_world_camera[:3, 3]
        if self._last_m is not None:
            self._path_m += float(np.linalg.norm(place - self._last_m))
        self._last_m = place.copy()
        self._frames += 1

    @property
    def full(self) -> bool:
        """Whether the submap is to be closed."""
        s, limit = self._settings, self._max_bytes
        long = self._path_m >= s.length_m or self._frames >= _MAX_FRAMES
        return long or (limit is not None and self._fused.nbytes + self._occupancy.nbytes >= limit)

    def current(self) -> Submap:
        """Return the submap so far; without frames it is empty."""
        return Submap(
            self._index, self._first_frame, self._frames, self._fused.part(), self._occupancy.part()
        )

    def close(self) -> Submap:
        """Return the submap, whose place the next one takes."""
        submap = Submap(
            self._index,
            self._first_frame,
            self._frames,
            self._fused.take().rounded(),
            self._occupancy.take(),
        )
        self._first_frame += self._frames
        self._index, self._frames, self._path_m = self._index + 1, 0, 0.0
        return submap

    def state(self) -> dict[str, Any]:
        """Return all that decides what comes later, as a tree of arrays and plain values."""
        return {"submap": self.current().to_tree(), "path_m": self._path_m, "last_m": self._last_m}

    def restore(self, state: dict[str, Any]) -> None:
        """Go on from a `state`."""
        submap = Submap.from_tree(state["submap"])
        self._index, self._first_frame = submap.index, submap.first_frame
        self._frames = submap.frames
        self._path_m, self._last_m = state["path_m"], state["last_m"]
        self._fused.resume(submap.fused, submap.frames)
        self._occupancy.resume(submap.occupancy)
