"""How right and how complete a cloud is, against a reference cloud."""

from __future__ import annotations

import numpy as np

from recon.adapters import open3d_clouds
from recon.errors import EvaluationError
from recon.structures import MapMetrics, PointCloud
from recon.structures.arrays import Float32


def evaluate_map(
    cloud: PointCloud, reference: PointCloud, threshold_m: float, voxel_m: float | None = None
) -> MapMetrics:
    """Compare a cloud with a reference in the same frame.

    Both clouds are first reduced to one point per voxel. Without that a map is judged by where
    it happens to be dense: a stereo cloud has a hundred times more points on a wall at 3 m than
    on one at 30 m.

    Args:
        cloud: The estimate.
        reference: What is taken as true; what it did not see counts against the precision.
        threshold_m: Distance below which a point counts as right.
        voxel_m: Edge of the voxels; None = half of the threshold.

    Returns:
        Precision, recall, their harmonic mean, and the distances from the estimate to the
        reference.

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


def nearest_distances(xyz: Float32, reference_xyz: Float32) -> Float32:
    """Distance of each point to the nearest reference point.

    Args:
        xyz: float32 (N, 3), metres.
        reference_xyz: float32 (M, 3), metres, M > 0.

    Returns:
        float32 (N,), metres.

    Raises:
        EvaluationError: There is no reference point.
    """
    if len(reference_xyz) == 0:
        raise EvaluationError("the reference cloud is empty")
    return open3d_clouds.nearest(xyz, reference_xyz)[1][:, 0]


def _check(cloud: PointCloud, reference: PointCloud, threshold_m: float) -> None:
    """Raise where a comparison would mean nothing."""
    for name, points in (("estimated", cloud), ("reference", reference)):
        if len(points) == 0:
            raise EvaluationError(f"the {name} cloud is empty")
    if cloud.frame != reference.frame:
        raise EvaluationError(
            "the clouds are in different frames",
            got=f"{cloud.frame} and {reference.frame}",
            hint="transform one of them first",
        )
    if not (np.isfinite(threshold_m) and threshold_m > 0):
        raise EvaluationError("the threshold is not positive", got=f"{threshold_m:g} m")


def _thinned(cloud: PointCloud, voxel_m: float) -> Float32:
    """float32 (M, 3), the mean point of each voxel."""
    return open3d_clouds.voxel_downsample(cloud.xyz, np.zeros((len(cloud), 0)), voxel_m)[0]
