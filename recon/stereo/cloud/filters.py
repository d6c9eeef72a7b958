"""Filters of clouds: voxel downsampling and outlier removal."""

from __future__ import annotations

from dataclasses import replace
from typing import Any, Final

import numpy as np
from numpy.typing import NDArray
from pydantic import Field

from recon.core.settings import Settings
from recon.core.values import PointCloud
from recon.core.values.arrays import Float32
from recon.stereo.cloud import open3d_clouds

_STATISTICAL_SIGMAS: Final = 2.0
"""Limit of the statistical filter, in standard deviations of the mean distance."""

_RADIUS_NEIGHBOURS: Final = 2
"""Neighbours that a point needs within the radius: fewer are an island."""


class FilterSettings(Settings):
    """Which filters are applied to a cloud, in this order; none turns one off."""

    voxel_m: float | None = Field(
        default=None,
        ge=1e-6,
        le=1e6,
        description="Edge of the voxels that points are averaged in. Set it for fewer points.",
    )
    statistical_neighbours: int | None = Field(
        default=None,
        ge=1,
        le=100,
        description="Neighbours of the statistical outlier filter, which drops points that are "
        "farther from them than most. Several times as slow as the others; for one pair, or a "
        "map with noise in the air.",
    )
    radius_m: float | None = Field(
        default=None,
        ge=1e-6,
        le=1e6,
        description="Points with fewer than two others within this radius are dropped. About "
        "three voxels; larger drops larger islands.",
    )


ANY_SCALE: Final = FilterSettings(statistical_neighbours=20)
"""For the cloud of one pair, whose scale is unknown: no filter with a length in metres."""


def filter_cloud(cloud: PointCloud, settings: FilterSettings) -> PointCloud:
    """Thin a cloud, which makes the searches for neighbours cheap, then drop its outliers.

    In a voxel every attribute is averaged (``sigma_m`` too: the errors of neighbouring pixels are
    not independent), and normals are renormalised.
    """
    if settings.voxel_m is not None and len(cloud):
        cloud = voxel_downsample(cloud, settings.voxel_m)
    if settings.statistical_neighbours is not None:
        keep = open3d_clouds.statistical_inliers(
            cloud.xyz, settings.statistical_neighbours, _STATISTICAL_SIGMAS
        )
        cloud = cloud.select(keep)
    if settings.radius_m is not None:
        keep = open3d_clouds.radius_inliers(cloud.xyz, _RADIUS_NEIGHBOURS, settings.radius_m)
        cloud = cloud.select(keep)
    return cloud


def voxel_downsample(cloud: PointCloud, voxel_m: float) -> PointCloud:
    """Return one point per voxel, the mean of its points in every attribute."""
    names = [name for name in _ATTRIBUTES if getattr(cloud, name) is not None]
    columns = [np.reshape(getattr(cloud, name), (len(cloud), -1)) for name in names]
    packed = np.concatenate(columns, axis=1) if columns else np.zeros((len(cloud), 0))
    xyz, means = open3d_clouds.voxel_downsample(cloud.xyz, packed, voxel_m)
    widths = np.cumsum([column.shape[1] for column in columns])[:-1]
    parts = dict(zip(names, np.split(means, widths, axis=1), strict=True)) if names else {}
    fields: dict[str, Any] = {name: _restored(name, parts[name]) for name in names}
    return replace(cloud, xyz=xyz, **fields)


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
    """Return the mean of an attribute, converted to the dtype and shape used in a cloud."""
    if name == "normals":
        length = np.linalg.norm(mean, axis=1, keepdims=True)
        return np.asarray(mean / np.maximum(length, np.float32(1e-12)), dtype=np.float32)
    dtype = np.dtype(_ATTRIBUTES[name])
    rounded = np.rint(mean) if dtype.kind in "iu" else mean
    return rounded.astype(dtype) if name == "rgb" else rounded[:, 0].astype(dtype)
