"""How much of the cloud of a pair lies on its mesh."""

from __future__ import annotations

import math
from typing import Final

import numpy as np

from recon.core.open3d_raycasting import RayScene
from recon.core.values import PointCloud, TriangleMesh

# A point is covered if the mesh is no farther from it than this fraction of its depth.
COVERED_WITHIN: Final = 0.005
LEAST_COVERAGE: Final = 0.8  # fraction of the points of a pair that its mesh should cover
_COVERAGE_SAMPLES: Final = 100_000


def mesh_coverage(mesh: TriangleMesh, cloud: PointCloud) -> float:
    """Return the fraction of the points of a pair that are covered by its mesh, from 0 to 1.

    Of more than 100,000 points, every n-th is used.
    """
    xyz = cloud.xyz[:: math.ceil(len(cloud) / _COVERAGE_SAMPLES)]
    distance_m = RayScene(mesh.vertices[mesh.faces]).distance(xyz)
    return float(np.mean(distance_m <= COVERED_WITHIN * xyz[:, 2]))


def check_coverage(coverage: float) -> tuple[str, ...]:
    """Return a warning if the mesh of a pair leaves out much of its cloud."""
    if coverage >= LEAST_COVERAGE:
        return ()
    tolerance = f"points within {100 * COVERED_WITHIN:g} % of their depth"
    advice = "lower mesh.min_component_faces, or use the cloud"
    return (f"the mesh covers {100 * coverage:.2g} % of the cloud ({tolerance}); {advice}",)
