"""From posed clouds to a fused cloud, 3-D occupancy and a flat grid."""

from recon.map.axes import (
    AxesSettings,
    GroundPlane,
    base_axes,
    estimate_ground,
    map_axes,
)
from recon.map.driven import DrivenPath, is_driven, sweep
from recon.map.floor import add_floors, find_floors
from recon.map.fused import FusionSettings, MapBuilder, fusion_range_m
from recon.map.grid import GridSettings, drop_undecided, flatten
from recon.map.ground import (
    GroundSettings,
    GroundSurface,
    estimate_ground_surface,
    measure_camera_height,
)
from recon.map.occupancy import OccupancyBuilder, OccupancySettings
from recon.map.occupancy_part import free_part
from recon.map.rays import ray_grain, thin_rays
from recon.map.store import Key, Store
from recon.map.submaps import Submap, SubmapBuilder, SubmapMotion, SubmapSettings

__all__ = [
    "AxesSettings",
    "DrivenPath",
    "FusionSettings",
    "GridSettings",
    "GroundPlane",
    "GroundSettings",
    "GroundSurface",
    "Key",
    "MapBuilder",
    "OccupancyBuilder",
    "OccupancySettings",
    "Store",
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
