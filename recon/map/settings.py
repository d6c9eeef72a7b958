"""Settings of a drive: what determines its map."""

from __future__ import annotations

from pydantic import Field

from recon.core.settings import Settings
from recon.map.fusion.builder import FusionSettings
from recon.map.ground.axes import AxesSettings
from recon.map.ground.grid import GridSettings
from recon.map.ground.surface import GroundSettings
from recon.map.occupancy.builder import OccupancySettings
from recon.map.submaps import SubmapSettings
from recon.odometry.settings import OdometrySettings
from recon.run.memory import MemorySettings
from recon.stereo.cloud.filters import FilterSettings
from recon.stereo.settings import StereoSettings


class CheckpointSettings(Settings):
    """How often the map is committed while a drive is mapped; does not change results."""

    every_frames: int = Field(
        50, ge=1, le=1_000_000, description="Number of frames between two checkpoints."
    )


class LoopSettings(Settings):
    """Loop closure: recognising a place, verifying it and correcting the path."""

    enabled: bool = Field(
        True,
        description="Look for loops and close them. Turn it off where the path has none, for "
        "speed.",
    )


class DriveSettings(StereoSettings):
    """Everything that determines the map of a drive."""

    map_filters: FilterSettings = Field(
        default=FilterSettings(radius_m=0.3),
        description="Filters of the fused cloud on export, in this order; none turns one off.",
    )
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
