"""Filters of clouds: voxel downsampling, outlier removal, normals."""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import numpy as np
from numpy.typing import NDArray
from pydantic import Field

from recon.core.settings import Settings
from recon.core.values import PointCloud
from recon.core.values.arrays import Float32
from recon.stereo.cloud import open3d_clouds

_MIN_POINTS_OF_A_PLANE = 3


class FilterSettings(Settings):
    """Which filters are applied to a cloud, in this order; null turns one off.

    The defaults suit one frame of a drive: outlier removal takes several times as long as voxel
    downsampling and gains about two per cent of precision, while the map drops points that few
    frames saw anyway.
    """

    voxel_m: float | None = Field(
        default=0.1, gt=0, description="Edge of the voxels that points are averaged in."
    )
    statistical_neighbours: int | None = Field(
        default=None, ge=1, le=1000, description="Neighbours of the statistical outlier filter."
    )
    statistical_sigmas: float = Field(
        default=2.0,
        gt=0,
        description="Limit of that filter, in standard deviations of the mean distance.",
    )
    radius_m: float | None = Field(
        default=None, gt=0, description="Radius of the radius outlier filter."
    )
    radius_neighbours: int = Field(
        default=4, ge=1, description="Neighbours that a point needs within that radius."
    )
    normals_neighbours: int | None = Field(
        default=None, ge=3, le=1000, description="Estimate new normals from so many points."
    )


#: For the cloud of one pair, whose scale is unknown: no filter with a length in metres.
ANY_SCALE = FilterSettings(voxel_m=None, statistical_neighbours=20)


def filter_cloud(
    cloud: PointCloud,
    settings: FilterSettings,
    viewpoint_m: tuple[float, float, float] = (0.0, 0.0, 0.0),
) -> PointCloud:
    """Thin a cloud, drop its outliers, and estimate its normals.

    Downsampling comes first, which makes the neighbour searches cheap and evenly spaced.

    Args:
        cloud: Any cloud.
        settings: The filters and their settings.
        viewpoint_m: The camera, in the frame of the cloud. Estimated normals point to it if the
            cloud had none to agree with.

    Returns:
        A cloud in the same frame. In a voxel every attribute is averaged (``sigma_m`` too: the
        errors of neighbouring pixels are not independent), and normals are renormalised.

    Raises:
        SettingsError: The voxel is too small for the extent of the cloud.
    """
    if settings.voxel_m is not None and len(cloud):
        cloud = voxel_downsample(cloud, settings.voxel_m)
    if settings.statistical_neighbours is not None:
        keep = open3d_clouds.statistical_inliers(
            cloud.xyz, settings.statistical_neighbours, settings.statistical_sigmas
        )
        cloud = cloud.select(keep)
    if settings.radius_m is not None:
        cloud = cloud.select(
            open3d_clouds.radius_inliers(cloud.xyz, settings.radius_neighbours, settings.radius_m)
        )
    if settings.normals_neighbours is not None:
        cloud = with_normals(cloud, settings.normals_neighbours, viewpoint_m)
    return cloud


def voxel_downsample(cloud: PointCloud, voxel_m: float) -> PointCloud:
    """One point per voxel, the mean of its points in every attribute.

    Raises:
        SettingsError: The voxel is too small for the extent of the cloud.
    """
    names = [name for name in _ATTRIBUTES if getattr(cloud, name) is not None]
    columns = [np.reshape(getattr(cloud, name), (len(cloud), -1)) for name in names]
    packed = np.concatenate(columns, axis=1) if columns else np.zeros((len(cloud), 0))
    xyz, means = open3d_clouds.voxel_downsample(cloud.xyz, packed, voxel_m)
    widths = np.cumsum([column.shape[1] for column in columns])[:-1]
    parts = dict(zip(names, np.split(means, widths, axis=1), strict=True)) if names else {}
    fields: dict[str, Any] = {name: _restored(name, parts[name]) for name in names}
    return replace(cloud, xyz=xyz, **fields)


def with_normals(
    cloud: PointCloud, neighbours: int, viewpoint_m: tuple[float, float, float] = (0.0, 0.0, 0.0)
) -> PointCloud:
    """Estimate normals from nearest neighbours.

    Args:
        cloud: Any cloud; with fewer than three points it is returned unchanged.
        neighbours: Number of neighbours, the point included.
        viewpoint_m: See `filter_cloud`.
    """
    if len(cloud) < _MIN_POINTS_OF_A_PLANE:
        return cloud
    normals = open3d_clouds.estimate_normals(cloud.xyz, neighbours)
    towards = np.asarray(viewpoint_m, dtype=np.float32) - cloud.xyz
    if cloud.normals is not None:
        towards = cloud.normals
    away = np.einsum("ij,ij->i", normals, towards) < 0
    return replace(cloud, normals=np.where(away[:, None], -normals, normals))


#: Attributes of a point except its position, and the dtype that a mean is converted to.
_ATTRIBUTES = {
    "rgb": np.uint8,
    "normals": np.float32,
    "sigma_m": np.float32,
    "confidence": np.float32,
    "weight": np.float32,
    "count": np.int32,
}


def _restored(name: str, mean: Float32) -> NDArray[Any]:
    """The mean of an attribute, converted to the dtype and shape used in a cloud."""
    if name == "normals":
        length = np.linalg.norm(mean, axis=1, keepdims=True)
        return np.asarray(mean / np.maximum(length, np.float32(1e-12)), dtype=np.float32)
    dtype = np.dtype(_ATTRIBUTES[name])
    rounded = np.rint(mean) if dtype.kind in "iu" else mean
    return rounded.astype(dtype) if name == "rgb" else rounded[:, 0].astype(dtype)
