"""Back-projection of a disparity map to 3-D points with uncertainties."""

from __future__ import annotations

import sys
from typing import Final

import numpy as np
from pydantic import Field

from recon.core.errors import ShapeError
from recon.core.settings import Settings
from recon.core.values import Disparity, PointCloud, RectifiedCamera, RectifiedPair
from recon.stereo.kernels import points

_NORMALS_RADIUS_PX: Final = 3
"""Half width of the window that gives a point its normal."""


class CloudSettings(Settings):
    """Which pixels become points."""

    remove_flying_edges: bool = Field(
        default=True,
        description="Drop pixels that float between a foreground and its background. Turn it off "
        "to see what the matcher found.",
    )
    min_range_m: float = Field(
        default=0.1,
        ge=0,
        le=1e6,
        description="Nearest depth kept. Set it to hide a bonnet or gripper.",
    )
    max_range_m: float | None = Field(
        default=30.0,
        ge=1e-6,
        le=1e6,
        description="Farthest depth kept; none = no limit. The error of a depth grows with its "
        "square.",
    )
    max_relative_sigma: float | None = Field(
        default=0.1,
        ge=1e-6,
        le=1e6,
        description="Largest standard deviation of a depth kept, as a share of it; none = no "
        "limit. Smaller for fewer, more certain points.",
    )
    min_confidence: float = Field(
        default=0.0,
        ge=0,
        le=1,
        description="Least confidence kept: the probability that a match is right. Raise it where "
        "wrong points matter more than missing ones.",
    )
    stride: int = Field(
        default=1,
        ge=1,
        le=16,
        description="Every n-th row and column is used. Raise it for speed with large images.",
    )


def back_project(
    disparity: Disparity, pair: RectifiedPair, settings: CloudSettings, *, normals: bool = True
) -> PointCloud:
    """Return points of the pixels that have a disparity, ``Z = f·b / (d + doffs)``.

    Args:
        disparity: The disparity of ``pair``.
        pair: Provides the camera, the colours and the pixels valid after rectification.
        settings: Range, confidence and thinning.
        normals: Whether points get normals, which takes as long as the rest.

    Returns:
        A cloud in camera axes with colours, ``sigma_m`` (``sigma_z = Z²·sigma_d / (f·b)``),
        confidence and, if asked for, normals towards the camera; points in row order. It may
        be empty.
    """
    if disparity.values.shape != pair.left.shape:
        raise ShapeError(
            "disparity and image differ in size",
            got=f"disparity {disparity.values.shape}",
            expected=f"{pair.left.shape}",
        )
    found = points.make_points(_maps(disparity, pair), _rules(pair.camera, settings, normals))
    return PointCloud(
        xyz=found.xyz,
        rgb=found.colours,
        normals=found.normals if normals else None,
        sigma_m=found.sigma,
        confidence=found.confidence,
        frame="camera",
    )


def _maps(disparity: Disparity, pair: RectifiedPair) -> points.Maps:
    return points.Maps(
        values=disparity.values,
        confidence=disparity.confidence,
        sigma=disparity.sigma_px,
        colours=pair.left[:, :, None] if pair.left_rgb is None else pair.left_rgb,
        usable=np.zeros((0, 0), np.bool_) if pair.valid is None else pair.valid,
    )


def _rules(camera: RectifiedCamera, settings: CloudSettings, normals: bool) -> points.PointRules:
    return points.PointRules(
        focal=float(camera.focal_px),
        cx=float(camera.cx_px),
        cy=float(camera.cy_px),
        fb=float(camera.focal_px * camera.baseline_m),
        doffs=float(camera.doffs_px),
        nearest=settings.min_range_m,
        farthest=_or_infinity(settings.max_range_m),
        relative_sigma=_or_infinity(settings.max_relative_sigma),
        confidence=settings.min_confidence,
        stride=settings.stride,
        radius=_NORMALS_RADIUS_PX if normals else 0,
    )


def _or_infinity(limit: float | None) -> float:
    # The largest float, not infinity: 0 · inf is NaN, and infinite depths must be rejected.
    return sys.float_info.max if limit is None else limit
