"""Rays of a frame that are kept for occupancy: points averaged in small cubes, and rounded.

Maps are built from the kept rays, so that the same map can be built again, and others with other
voxels, heights or poses.
"""

from __future__ import annotations

from typing import Final

import numpy as np

from recon.core.kernels import voxels
from recon.core.values import PointCloud, RayCloud, RayGrain
from recon.map.kernels import raycast
from recon.map.occupancy.builder import (
    FREE_MARGIN_SIGMAS,
    OccupancySettings,
    check_camera_cloud,
    sigma_and_confidence,
)

_UNITS_PER_CELL: Final = 64
_LARGEST: Final = np.iinfo(np.int16).max - 1
_FIRST_ROWS: Final = 1 << 15


def ray_grain(settings: OccupancySettings) -> RayGrain:
    """Return the resolution of the rays that are kept for a map."""
    cell_m = settings.resolution_m / settings.rays_per_voxel
    # The farthest places must fit into 16 bits.
    unit_m = max(cell_m / _UNITS_PER_CELL, (_beyond_m(settings) + cell_m) / _LARGEST)
    return RayGrain(cell_m, unit_m, settings.max_range_m)


def thin_rays(cloud: PointCloud, settings: OccupancySettings) -> RayCloud:
    """Average the points of a frame in cubes; points without confidence are dropped.

    A point out of the map's range is moved along its ray to just beyond it: it is still no hit, and
    frees the same space.

    Args:
        cloud: Points in camera axes. ``sigma_m`` None = exact; ``confidence`` None = 1.
        settings: Of the map.
    """
    check_camera_cloud(cloud)
    grain = ray_grain(settings)
    sigma_m, sure = sigma_and_confidence(cloud)
    xyz, sigma_m = raycast.limit_points(
        cloud.xyz,
        sigma_m,
        settings.max_range_m,
        _beyond_m(settings),
        FREE_MARGIN_SIGMAS,
    )
    points = voxels.VoxelPoints(
        xyz, (sure > 0).astype(np.float32), np.stack([sigma_m, sure], axis=1)
    )
    found = voxels.add_points(voxels.make_sums(_FIRST_ROWS, 2), points, grain.cell_m, 0)
    used = int(found.used[0])
    number = found.sums[:used, 0]
    mean = found.sums[:used, 1:] / number[:, None]
    places = (voxels.unpack_keys(found.keys[:used]) + 0.5) * grain.cell_m + mean[:, :3]
    return RayCloud(
        places=np.rint(places / grain.unit_m).astype(np.int16),
        sigma_m=mean[:, 3].astype(np.float16),
        confidence=np.clip(np.rint(255 * mean[:, 4]), 1, 255).astype(np.uint8),
        count=np.minimum(number, 255).astype(np.uint8),
        unit_m=grain.unit_m,
    )


def _beyond_m(settings: OccupancySettings) -> float:
    """Return where points out of range are moved to: never into a cube with one in range."""
    return settings.max_range_m + 2 * settings.resolution_m / settings.rays_per_voxel
