"""From a disparity map to points in space, each with its uncertainty."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray
from pydantic import Field

from recon.cloud.normals import normals_from_disparity
from recon.errors import ShapeError
from recon.geometry.projection import unproject
from recon.geometry.triangulation import depth_from_disparity, depth_sigma
from recon.settings import Settings
from recon.structures import Disparity, PointCloud, RectifiedPair
from recon.structures.arrays import Bool, Float32, UInt8

Index = NDArray[np.intp]


class CloudSettings(Settings):
    """Which pixels become points."""

    min_range_m: float = Field(default=0.1, ge=0, description="nearest depth kept")
    max_range_m: float | None = Field(
        default=30.0, gt=0, description="farthest depth kept; null = no limit"
    )
    max_relative_sigma: float | None = Field(
        default=0.1, gt=0, description="largest sigma_z / Z kept; null = no limit"
    )
    min_confidence: float = Field(default=0.0, ge=0, le=1, description="least confidence kept")
    stride: int = Field(default=1, ge=1, le=16, description="every n-th row and column is used")
    normals_radius_px: int | None = Field(
        default=3,
        ge=1,
        le=20,
        description="half width of the window that gives a point its normal; null = no normals",
    )


def back_project(disparity: Disparity, pair: RectifiedPair, settings: CloudSettings) -> PointCloud:
    """Points of the pixels that have a disparity, ``Z = f·b / (d + doffs)``.

    Args:
        disparity: What a matcher found in ``pair``.
        pair: Gives the camera, the colours and the pixels that rectification left valid.
        settings: Range, confidence and thinning.

    Returns:
        A cloud in camera axes with colours, ``sigma_m`` (``sigma_z = Z²·sigma_d / (f·b)``),
        confidence and, if asked for, normals towards the camera; points in row order. It may
        be empty.

    Raises:
        ShapeError: The disparity and the pair differ in size.
    """
    if disparity.values.shape != pair.left.shape:
        raise ShapeError(
            "disparity and picture differ in size",
            got=f"disparity {disparity.values.shape}",
            expected=f"{pair.left.shape}",
        )
    rows, columns, depth_m, sigma_m = _pixels(disparity, pair, settings)
    at = (rows, columns)
    u, v = columns.astype(np.float32), rows.astype(np.float32)
    radius_px = settings.normals_radius_px
    return PointCloud(
        xyz=unproject(u, v, depth_m, pair.camera),
        rgb=_colours(pair, at),
        normals=None
        if radius_px is None
        else normals_from_disparity(disparity.values, at, pair.camera, radius_px),
        sigma_m=sigma_m,
        confidence=disparity.confidence[at],
        frame="camera",
    )


def _pixels(
    disparity: Disparity, pair: RectifiedPair, settings: CloudSettings
) -> tuple[Index, Index, Float32, Float32]:
    """Rows, columns, depths and depth errors of the pixels that become points."""
    usable = disparity.valid & (disparity.confidence >= settings.min_confidence)
    if pair.valid is not None:
        usable &= pair.valid
    step = settings.stride
    rows, columns = np.nonzero(usable[::step, ::step])
    rows, columns = rows * step, columns * step
    depth_m = depth_from_disparity(disparity.values[rows, columns], pair.camera)
    sigma_m = depth_sigma(depth_m, disparity.sigma_px[rows, columns], pair.camera)
    keep = _in_range(depth_m, sigma_m, settings)
    return rows[keep], columns[keep], depth_m[keep], sigma_m[keep]


def _in_range(depth_m: Float32, sigma_m: Float32, settings: CloudSettings) -> Bool:
    """bool (N,): in front of the camera, neither too near, too far nor too uncertain."""
    keep = np.isfinite(depth_m) & (depth_m >= settings.min_range_m)
    if settings.max_range_m is not None:
        keep &= depth_m <= settings.max_range_m
    if settings.max_relative_sigma is not None:
        keep &= sigma_m <= settings.max_relative_sigma * depth_m
    return np.asarray(keep)


def _colours(pair: RectifiedPair, at: tuple[Index, Index]) -> UInt8:
    """uint8 (N, 3), the colours of some pixels, or their grey thrice."""
    if pair.left_rgb is not None:
        return pair.left_rgb[at]
    return np.repeat(pair.left[at][:, None], 3, axis=1)
