"""Open3D's ICP: arrays in, a transform out, its errors converted to ours."""

from __future__ import annotations

from typing import Any

import numpy as np
import open3d as o3d
from numpy.typing import NDArray

from recon.core.errors import RegistrationError
from recon.core.values.arrays import Float64

_ITERATIONS = 60
_NORMAL_NEIGHBOURS = 20
_CONVERGED = 1e-7


def icp(
    xyz: NDArray[Any], reference_xyz: NDArray[Any], reaches_m: tuple[float, ...]
) -> tuple[Float64, float]:
    """Align points to a reference cloud by robust point-to-plane ICP.

    Args:
        xyz: (N, 3), metres, finite, roughly aligned.
        reference_xyz: (M, 3), metres, finite.
        reaches_m: Maximum correspondence distance of each pass, decreasing.

    Returns:
        float64 (4, 4), ``T_reference_points``, and the share of the points that have a
        correspondence in the last pass.

    Ref: Chen & Medioni, "Object modelling by registration of multiple range images", 1992;
    robust weights: Babin et al., "Analysis of robust functions for registration algorithms", 2019.
    """
    registration = o3d.pipelines.registration
    # Far from the origin, a small rotation about it is a large motion: centre both clouds.
    centre = np.mean(reference_xyz, axis=0, dtype=np.float64)
    source, target = _cloud(xyz - centre), _cloud(reference_xyz - centre)
    criteria = registration.ICPConvergenceCriteria(_CONVERGED, _CONVERGED, _ITERATIONS)
    T, fitness = np.eye(4), 0.0
    with o3d.utility.VerbosityContextManager(o3d.utility.VerbosityLevel.Error):
        target.estimate_normals(o3d.geometry.KDTreeSearchParamKNN(_NORMAL_NEIGHBOURS))
        for reach_m in reaches_m:
            kernel = registration.TukeyLoss(k=reach_m)
            estimation = registration.TransformationEstimationPointToPlane(kernel)
            found = registration.registration_icp(source, target, reach_m, T, estimation, criteria)
            T, fitness = np.asarray(found.transformation).copy(), float(found.fitness)
            if fitness == 0 or not np.isfinite(T).all():
                raise RegistrationError(
                    "ICP found no corresponding points",
                    expected=f"clouds within {reach_m:g} m of each other",
                )
    there, back = np.eye(4), np.eye(4)
    there[:3, 3], back[:3, 3] = centre, -centre
    return there @ T @ back, fitness


def _cloud(xyz: NDArray[Any]) -> Any:
    return o3d.geometry.PointCloud(o3d.utility.Vector3dVector(np.array(xyz, dtype=np.float64)))
