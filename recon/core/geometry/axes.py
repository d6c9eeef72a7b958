"""Clouds in other axes, and the axes that viewers of 3-D files expect."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import replace
from types import MappingProxyType
from typing import Any, Final

import numpy as np
from numpy.typing import NDArray

from recon.core.geometry.se3 import apply, rotate
from recon.core.values import Frame, PointCloud
from recon.core.values.arrays import Float64


def _rigid(rotation: list[list[int]]) -> Float64:
    T = np.eye(4)
    T[:3, :3] = rotation
    return T


_OF_CAMERA: Final = _rigid([[1, 0, 0], [0, -1, 0], [0, 0, -1]])
_OF_MAP: Final = _rigid([[0, -1, 0], [0, 0, 1], [-1, 0, 0]])

T_YUP_FRAME: Final[Mapping[Frame, Float64]] = MappingProxyType(
    {"camera": _OF_CAMERA, "world": _OF_CAMERA, "map": _OF_MAP}
)
"""float64 (4, 4), from each frame to x right, y up and z backwards, the axes of glTF and MeshLab:
what a camera saw in front of it is in front of the viewer."""


def transform_cloud(cloud: PointCloud, T: NDArray[Any], *, frame: Frame) -> PointCloud:
    """Transform a cloud to another frame; only positions and normals change.

    Args:
        cloud: Cloud in any frame.
        T: float64 (4, 4), maps points of ``cloud.frame`` to ``frame``.
        frame: Name of the new frame.
    """
    normals = None if cloud.normals is None else rotate(T, cloud.normals)
    return replace(cloud, xyz=apply(T, cloud.xyz), normals=normals, frame=frame)
