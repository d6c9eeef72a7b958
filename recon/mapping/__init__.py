"""From posed clouds to a fused cloud, 3-D occupancy and a flat grid."""

from recon.mapping.axes import (
    AxesSettings,
    GroundPlane,
    base_axes,
    estimate_ground,
    map_axes,
)
from recon.mapping.driven import DrivenPath, is_driven, sweep
from recon.mapping.floor import add_floors, find_floors
from recon.mapping.fused import FusionSettings, MapBuilder, fusion_range_m
from recon.mapping.grid import GridSettings, drop_undecided, flatten
from recon.mapping.ground import (
    GroundSettings,
    GroundSurface,
    estimate_ground_surface,
    measure_camera_height,
)
from recon.mapping.occupancy import OccupancyBuilder, OccupancySettings
from recon.mapping.occupancy_part import free_part
from recon.mapping.rays import ray_grain, thin_rays
from recon.mapping.submaps import Submap, SubmapBuilder, SubmapMotion, SubmapSettings

__all__ = [
    "AxesSettings",
    "DrivenPath",
    "FusionSettings",
    "GridSettings",
    "GroundPlane",
    "GroundSettings",
    "GroundSurface",
    "MapBuilder",
    "OccupancyBuilder",
    "OccupancySettings",
    "Submap",
    "SubmapBuilder",
    "SubmapMotion",
    "SubmapSettings",
    "add_floors",
    "base_axes",
    "drop_undecided",
    "estimate_ground",
    "estimate_ground_surface",
    "find_floors",
    "flatten",
    "free_part",
    "fusion_range_m",
    "is_driven",
    "map_axes",
    "measure_camera_height",
    "ray_grain",
    "sweep",
    "thin_rays",
]
