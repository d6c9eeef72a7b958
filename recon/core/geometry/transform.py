"""Transformation of clouds between frames."""

from __future__ import annotations

from dataclasses import replace
from typing import Any

from numpy.typing import NDArray

from recon.core.geometry.se3 import apply, rotate
from recon.core.values import Frame, PointCloud


def transform_cloud(cloud: PointCloud, T: NDArray[Any], *, frame: Frame) -> PointCloud:
    """Transform a cloud to another frame; only positions and normals change.

    Args:
        cloud: Cloud in any frame.
        T: float64 (4, 4), maps points of ``cloud.frame`` to ``frame``.
        frame: Name of the new frame.
    """
    normals = None if cloud.normals is None else rotate(T, cloud.normals)
    return replace(cloud, xyz=apply(T, cloud.xyz), normals=normals, frame=frame)
