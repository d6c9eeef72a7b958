"""Settings of a drive: what determines its map."""

from __future__ import annotations

from pydantic import Field, model_validator
from typing_extensions import Self

from recon.core.settings import Settings
from recon.map.builders import OccupancySettings
from recon.map.fusion import FusionSettings
from recon.map.ground.axes import AxesSettings
from recon.map.ground.grid import GridSettings
from recon.map.ground.surface import GroundSettings
from recon.map.kernels.raycast import BLOCK_EDGE
from recon.map.submaps import SubmapSettings
from recon.odometry.settings import OdometrySettings, RigSettings
from recon.run.work import MemorySettings
from recon.stereo.frame import FilterSettings, StereoSettings


class CheckpointSettings(Settings):
    """How often the map is committed while a drive is mapped; does not change results."""

    every_frames: int = Field(50, ge=1, le=1_000_000)
    """Number of frames between two checkpoints."""


class LoopSettings(Settings):
    """Loop closure: recognising a place, verifying it and correcting the path."""

    enabled: bool = True
    """Look for loops and close them. Turn it off where the path has none, for speed."""


class DriveSettings(StereoSettings):
    """Everything that determines the map of a drive."""

    map_filters: FilterSettings = FilterSettings(radius_m=0.3)
    """Filters of the fused cloud on export, in this order; none turns one off."""
    rig: RigSettings = RigSettings()
    odometry: OdometrySettings = OdometrySettings()
    loops: LoopSettings = LoopSettings()
    axes: AxesSettings = AxesSettings()
    fusion: FusionSettings = FusionSettings()
    occupancy: OccupancySettings = OccupancySettings()
    submaps: SubmapSettings = SubmapSettings()
    checkpoints: CheckpointSettings = CheckpointSettings()
    memory: MemorySettings = MemorySettings()
    ground: GroundSettings = GroundSettings()
    grid: GridSettings = GridSettings()

    @model_validator(mode="after")
    def _check_margins(self) -> Self:
        """Refuse margins wider than a tile: each tile would be made of all those around it."""
        resolution_m, filters = self.occupancy.resolution_m, self.map_filters
        tile_m = max(self.submaps.tile_m, BLOCK_EDGE * resolution_m)
        for name, reach_m in (
            ("map_filters.voxel_m", 2 * (filters.voxel_m or 0.0)),
            ("map_filters.radius_m", filters.radius_m or 0.0),
            ("grid.min_blob_cells", self.grid.min_blob_cells * resolution_m),
        ):
            if reach_m > tile_m:
                raise ValueError(
                    f"{name} reaches {reach_m:g} m, beyond a tile of {tile_m:g} m (submaps.tile_m)"
                )
        return self
