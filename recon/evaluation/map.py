"""Accuracy and completeness of a cloud with respect to a reference cloud."""

from __future__ import annotations

from typing import Any, Final

import numpy as np
from numpy.typing import NDArray

from recon.core.errors import EvaluationError, RegistrationError
from recon.core.lazy import Lazy
from recon.core.values import MapMetrics, PointCloud, Trajectory
from recon.core.values.arrays import Bool, Float32, Float64
from recon.stereo import open3d_clouds

o3d = Lazy("open3d")

_BAND_PERCENT: Final = (0.1, 99.9)
_BAND_M: Final = 0.2
_ITERATIONS, _NORMAL_NEIGHBOURS, _CONVERGED = 60, 20, 1e-7  # of ICP


def evaluate_map(
    cloud: PointCloud, reference: PointCloud, threshold_m: float, voxel_m: float | None = None
) -> MapMetrics:
    """Compare a cloud with a reference in the same frame.

    Both clouds are first reduced to one point per voxel, so that dense regions do not dominate: a
    stereo cloud has a hundred times more points on a wall at 3 m than on one at 30 m.

    Args:
        cloud: The estimate.
        reference: The cloud taken as true; surfaces that it lacks count against the precision.
        threshold_m: Distance below which a point counts as correct.
        voxel_m: Voxel size; None = half of the threshold.

    Raises:
        EvaluationError: A cloud is empty, the frames differ, or the threshold is not positive.

    Ref: Knapitsch et al., "Tanks and Temples", ACM TOG 36(4), 2017, section 4.
    """
    _check(cloud, reference, threshold_m)
    voxel_m = threshold_m / 2 if voxel_m is None else voxel_m
    estimate_xyz, reference_xyz = _thinned(cloud, voxel_m), _thinned(reference, voxel_m)
    to_reference_m = nearest_distances(estimate_xyz, reference_xyz)
    precision = float(np.mean(to_reference_m < threshold_m))
    recall = float(np.mean(nearest_distances(reference_xyz, estimate_xyz) < threshold_m))
    found = precision + recall
    return MapMetrics(
        threshold_m=threshold_m,
        precision=precision,
        recall=recall,
        f_score=2 * precision * recall / found if found else 0.0,
        median_m=float(np.median(to_reference_m)),
        p95_m=float(np.percentile(to_reference_m, 95)),
        points=len(estimate_xyz),
        reference_points=len(reference_xyz),
    )


def within_reach(cloud: PointCloud, reference: PointCloud, path: Trajectory) -> Bool:
    """Return which points are within the heights, relative to the path, that the reference covers.

    A LiDAR sees little above its own height: points there can be neither confirmed nor refuted.
    The range is that of the whole reference, so that points floating above a road still count.
    """
    low_m, high_m = np.percentile(_heights_m(reference.xyz, path), _BAND_PERCENT)
    heights_m = _heights_m(cloud.xyz, path)
    return np.asarray((heights_m >= low_m - _BAND_M) & (heights_m <= high_m + _BAND_M))


def _heights_m(xyz: Float32, path: Trajectory) -> Float64:
    """Return float64 (N,): height above the nearest camera, along its y axis."""
    nearest = open3d_clouds.nearest(xyz, path.positions_m)[0][:, 0]
    down = path.T_world_camera[nearest, :3, 1]
    return np.asarray(-np.einsum("ni,ni->n", down, xyz - path.positions_m[nearest]))


def register_cloud(
    cloud: PointCloud, reference: PointCloud, reach_m: float
) -> tuple[Float64, float]:
    """Align a cloud to a reference by `icp`; only the errors of its shape are left.

    The cloud may be off by less than ten times ``reach_m``, the distance of partners at the end.
    """
    _check(cloud, reference, reach_m)
    xyz, reference_xyz = (_thinned(one, reach_m / 2) for one in (cloud, reference))
    return icp(xyz, reference_xyz, (10 * reach_m, 3 * reach_m, reach_m))


def nearest_distances(xyz: Float32, reference_xyz: Float32) -> Float32:
    """Return float32 (N,), the distance of each point to the nearest of the reference, metres."""
    return open3d_clouds.nearest(xyz, reference_xyz)[1][:, 0]


def _check(cloud: PointCloud, reference: PointCloud, threshold_m: float) -> None:
    if not (isinstance(cloud, PointCloud) and isinstance(reference, PointCloud)):
        raise EvaluationError(
            "only point clouds can be compared",
            got=f"{type(cloud).__name__} and {type(reference).__name__}",
            expected="two PointClouds, such as of read_ply",
        )
    for name, points in (("estimated", cloud), ("reference", reference)):
        if len(points) == 0:
            raise EvaluationError(f"the {name} cloud is empty")
    if cloud.frame != reference.frame:
        got, hint = f"{cloud.frame} and {reference.frame}", "transform one of them first"
        raise EvaluationError("the clouds are in different frames", got=got, hint=hint)
    if not (np.isfinite(threshold_m) and threshold_m > 0):
        raise EvaluationError("the threshold is not positive", got=f"{threshold_m:g} m")


def _thinned(cloud: PointCloud, voxel_m: float) -> Float32:
    return open3d_clouds.voxel_downsample(cloud.xyz, np.zeros((len(cloud), 0)), voxel_m)[0]


def icp(
    xyz: NDArray[Any], reference_xyz: NDArray[Any], reaches_m: tuple[float, ...]
) -> tuple[Float64, float]:
    """Align points (N, 3) to a reference cloud by robust point-to-plane ICP, from where they are.

    ``reaches_m``: largest distance of partners in each pass, decreasing. Returns
    ``T_reference_points``, and the fraction of the points that have a partner in the last pass.

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
                expected = f"clouds within {reach_m:g} m of each other"
                raise RegistrationError("ICP found no corresponding points", expected=expected)
    there, back = np.eye(4), np.eye(4)
    there[:3, 3], back[:3, 3] = centre, -centre
    return there @ T @ back, fitness


def _cloud(xyz: NDArray[Any]) -> Any:
    return o3d.geometry.PointCloud(o3d.utility.Vector3dVector(np.array(xyz, dtype=np.float64)))
