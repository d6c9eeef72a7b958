"""The axes that viewers of 3-D files expect."""

from __future__ import annotations

from collections.abc import Mapping
from types import MappingProxyType
from typing import Final

import numpy as np

from recon.core.values.arrays import Float64
from recon.core.values.cloud import Frame


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
