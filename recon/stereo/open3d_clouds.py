"""Open3D's point cloud filters: arrays in, arrays out, its errors converted to ours."""

from __future__ import annotations

from typing import Any, Final

import numpy as np
from numpy.typing import NDArray

from recon.core.errors import SettingsError, ShapeError
from recon.core.lazy import Lazy, quiet_open3d
from recon.core.values.arrays import Bool, Float32, Float64, Int32

o3d = Lazy("open3d")

# Open3D searches by squared distances, and float32 ends at 3e38.
_SEARCHABLE_M: Final = 1e18


def voxel_downsample(
    xyz: NDArray[Any], attributes: NDArray[Any], voxel_m: float
) -> tuple[Float32, Float32]:
    """Return one point per occupied voxel, (M, 3), and the means of attributes (N, K), (M, K)."""
    # Open3D averages three attributes per point (as colours), so they are passed in groups of
    # three; the order of its voxels depends only on positions and is the same for each group.
    groups = [attributes[:, k : k + 3] for k in range(0, attributes.shape[1], 3)]
    cloud = _legacy(xyz)
    if not groups:
        return _array(_voxelised(cloud, voxel_m).points), np.zeros((0, 0), dtype=np.float32)
    means = []
    for group in groups:
        padded = np.zeros((len(xyz), 3))
        padded[:, : group.shape[1]] = group
        cloud.colors = o3d.utility.Vector3dVector(padded)
        reduced = _voxelised(cloud, voxel_m)
        means.append(_array(reduced.colors)[:, : group.shape[1]])
    return _array(reduced.points), np.concatenate(means, axis=1)


def statistical_inliers(xyz: NDArray[Any], neighbours: int, sigmas: float) -> Bool:
    """Return bool (N,): the mean distance to neighbours is within ``sigmas`` of that of all."""
    if len(xyz) <= neighbours:
        return np.ones(len(xyz), dtype=bool)
    with quiet_open3d():
        _, index = _legacy(xyz).remove_statistical_outlier(neighbours, sigmas)
    mask = np.zeros(len(xyz), dtype=bool)
    mask[np.asarray(index, dtype=np.intp)] = True
    return mask


def radius_inliers(xyz: NDArray[Any], neighbours: int, radius_m: float | NDArray[Any]) -> Bool:
    """Return bool (N,), points that have at least ``neighbours`` others within ``radius_m``."""
    if len(xyz) <= neighbours:
        return np.zeros(len(xyz), dtype=bool)
    # Open3D's own filter finds all points within the radius: of a wide one it never ends.
    _, distances_m = nearest(xyz, xyz, neighbours + 1)  # the first is the point itself
    return np.asarray(distances_m[:, -1] < radius_m)


def estimate_normals(xyz: NDArray[Any], neighbours: int) -> Float32:
    """Return unit normals (N, 3) of planes fitted to each point's neighbours, of arbitrary sign."""
    cloud = _legacy(xyz)
    with quiet_open3d():
        cloud.estimate_normals(o3d.geometry.KDTreeSearchParamKNN(neighbours))
    return _array(cloud.normals)


def agree_normals(xyz: NDArray[Any], normals: NDArray[Any], neighbours: int) -> Float32:
    """Orient normals consistently between neighbours, along a minimum spanning tree.

    Ref: Hoppe et al., "Surface reconstruction from unorganized points", SIGGRAPH 1992.
    """
    try:
        return _orient(_legacy(xyz), normals, neighbours)
    except RuntimeError:
        # Qhull finds no simplex among points of one plane or one sphere; moved by a millionth of
        # their extent, the same way each time, it does.
        points = _finite(xyz)
        reach = 1e-6 * float(np.ptp(points, axis=0).max())
        moved = points + np.random.default_rng(0).uniform(-reach, reach, points.shape)
        return _orient(_legacy(moved), normals, neighbours)


def _orient(cloud: Any, normals: NDArray[Any], neighbours: int) -> Float32:
    cloud.normals = o3d.utility.Vector3dVector(np.array(normals, dtype=np.float64))
    with quiet_open3d():
        cloud.orient_normals_consistent_tangent_plane(min(neighbours, len(cloud.points) - 1))
    return _array(cloud.normals)


def nearest(
    query: NDArray[Any], reference: NDArray[Any], neighbours: int = 1
) -> tuple[Int32, Float32]:
    """Return the nearest reference points of each query point, nearest first.

    They are rows of ``reference``, int32 (N, neighbours), and distances in metres.
    """
    if len(reference) < neighbours:
        raise ShapeError(
            "too few points to search", got=len(reference), expected=f"at least {neighbours}"
        )
    if len(query) == 0:
        empty = np.zeros((0, neighbours))
        return empty.astype(np.int32), empty.astype(np.float32)
    # Far from the origin, squared float32 distances lose centimetres: centre both clouds.
    centre = np.mean(reference, axis=0, dtype=np.float64)
    moved = [_finite(xyz) - centre for xyz in (reference, query)]
    farthest_m = max(float(np.abs(xyz).max()) for xyz in moved)
    if farthest_m > _SEARCHABLE_M:
        raise ShapeError(
            "points lie too far apart to be searched",
            got=f"{farthest_m:.3g} m",
            expected=f"at most {_SEARCHABLE_M:.0e} m",
        )
    tensor = o3d.core.Tensor.from_numpy
    near_origin, points = (tensor(np.array(xyz, dtype=np.float32)) for xyz in moved)
    with quiet_open3d():
        search = o3d.core.nns.NearestNeighborSearch(near_origin)
        search.knn_index()
        index, squared = search.knn_search(points, neighbours)
    return index.numpy().astype(np.int32), np.sqrt(squared.numpy()).astype(np.float32)


def _voxelised(cloud: Any, voxel_m: float) -> Any:
    try:
        with quiet_open3d():
            return cloud.voxel_down_sample(voxel_m)
    except RuntimeError as error:
        raise SettingsError(
            "the voxel is too small for the extent of the cloud", got=f"{voxel_m:g} m"
        ) from error


def _legacy(xyz: NDArray[Any]) -> Any:
    """Return an Open3D cloud of a copy: it accepts neither read-only nor float32 arrays."""
    return o3d.geometry.PointCloud(o3d.utility.Vector3dVector(_finite(xyz).copy()))


def _finite(xyz: NDArray[Any]) -> Float64:
    points = np.asarray(xyz, dtype=np.float64)
    if not np.isfinite(points).all():
        raise ShapeError("a point of the cloud is not finite")
    return points


def _array(vectors: Any) -> Float32:
    return np.asarray(vectors).astype(np.float32)
