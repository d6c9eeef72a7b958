"""From posed clouds to a fused cloud, 3-D occupancy and a flat grid."""

from recon.mapping.axes import AxesSettings, GroundPlane, estimate_ground, map_axes
from recon.mapping.floor import add_floors, find_floors
from recon.mapping.fused import FusionSettings, MapBuilder, fusion_range_m
from recon.mapping.grid import GridSettings, drop_undecided, flatten
from recon.mapping.ground import (
    GroundSettings,
    GroundSurface,
    estimate_camera_height,
    estimate_ground_surface,
)
from recon.mapping.occupancy import OccupancyBuilder, OccupancySettings
from recon.mapping.rays import ray_grain, thin_rays
from recon.mapping.submaps import Submap, SubmapBuilder, SubmapMotion, SubmapSettings

__all__ = [
    "AxesSettings",
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
    "drop_undecided",
    "estimate_camera_height",
    "estimate_ground",
    "estimate_ground_surface",
    "find_floors",
    "flatten",
    "fusion_range_m",
    "map_axes",
    "ray_grain",
    "thin_rays",
]
