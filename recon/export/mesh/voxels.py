"""The surface of a map, through the points of its voxels: decision 0036."""

from __future__ import annotations

import math
from collections.abc import Callable
from typing import Final

import numpy as np

from recon.core.values import PointCloud, TriangleMesh
from recon.core.values.arrays import Bool, Float32
from recon.export.mesh.poisson import MeshSettings, oriented, trimmed, typical_spacing_m
from recon.map.kernels.distance import surface_of

_OF_SEVENTH: Final = math.sqrt(math.pi / 7)
"""Edge of the square that a point has for itself, as a fraction of the way to its seventh neighbour:
a circle that wide holds seven."""


def reconstruct_map_surface(
    cloud: PointCloud,
    settings: MeshSettings,
    voxel_m: float,
    wrong: Callable[[Float32], Bool] | None = None,
) -> TriangleMesh:
    """Return the surface that the points of a map lie on.

    Cells are as wide as its voxels, or two, four … times where points are that far apart. They
    have the same places in all parts of a map, so that these meet.

    Args:
        cloud: Points, with normals to the side that is free if possible; vertices take their
            colours.
        settings: Settings of the mesh.
        voxel_m: Edge of a voxel of the map.
        wrong: Returns which vertices (V, 3) cannot be on a surface; None = unknown.

    Raises:
        MeshingError: The points are too few, coincident or collinear, or no face was left.
    """
    cloud = oriented(cloud)
    apart = _OF_SEVENTH * typical_spacing_m(cloud.xyz) / voxel_m
    cell_m = voxel_m * 2 ** round(math.log2(max(apart, 1)))
    # In float32 the kernel would lose what a large coordinate leaves no digits for.
    origin = np.floor(cloud.xyz.min(axis=0) / cell_m).astype(np.float64)
    farthest = settings.max_distance_spacings or math.inf
    places, faces = surface_of(cloud.xyz / cell_m - origin, np.asarray(cloud.normals), farthest)
    vertices = ((places + origin) * cell_m).astype(np.float32)
    return trimmed((vertices, faces), cloud, settings, wrong)
