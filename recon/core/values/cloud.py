"""Point clouds with per-point attributes."""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass, fields, replace
from typing import Any, Literal

import numpy as np
from numpy.typing import NDArray

from recon.core.values.arrays import Float32, Int32, UInt8, extent_text, freeze
from recon.core.words import counted

Frame = Literal["camera", "world", "map"]


@dataclass(frozen=True, eq=False)
class PointCloud:
    """Points in one frame. Every field but ``xyz`` and ``frame`` may be None (unknown).

    Attributes:
        xyz: float32 (N, 3), metres, finite.
        rgb: uint8 (N, 3).
        normals: float32 (N, 3), unit length, towards the camera that saw the point.
        sigma_m: float32 (N,), standard deviation of the depth (``sigma_z``).
        confidence: float32 (N,) in [0, 1].
        weight: float32 (N,), sum of the weights of the fused measurements.
        count: int32 (N,), number of frames that saw the point; in a thinned frame, number of
            points that it replaces.
        frame: Frame of ``xyz``: camera (x right, y down, z forward), world (the first rectified
            left camera) or map (x forward, y left, z up).
    """

    xyz: Float32
    rgb: UInt8 | None = None
    normals: Float32 | None = None
    sigma_m: Float32 | None = None
    confidence: Float32 | None = None
    weight: Float32 | None = None
    count: Int32 | None = None
    frame: Frame = "camera"

    def __post_init__(self) -> None:
        freeze(self, "xyz", np.float32, (None, 3))
        n = len(self.xyz)
        freeze(self, "rgb", np.uint8, (n, 3))
        freeze(self, "normals", np.float32, (n, 3))
        for name in ("sigma_m", "confidence", "weight"):
            freeze(self, name, np.float32, (n,))
        freeze(self, "count", np.int32, (n,))

    def __repr__(self) -> str:
        known = [f.name for f in fields(self)[1:-1] if getattr(self, f.name) is not None]
        parts = (counted(len(self), "point"), extent_text(self.xyz), f"{self.frame} axes", *known)
        return f"PointCloud({', '.join(parts)})"

    def __len__(self) -> int:
        return len(self.xyz)

    def select(self, which: NDArray[Any]) -> PointCloud:
        """Return the points of a boolean mask (N,) or of an index array, in that order."""
        # Indexing by position is several times faster than by mask.
        index = np.flatnonzero(which) if which.dtype == np.bool_ else which
        arrays = {
            field.name: getattr(self, field.name).take(index, axis=0)
            for field in fields(self)
            if isinstance(getattr(self, field.name), np.ndarray)
        }
        return replace(self, **arrays)


def join_clouds(clouds: Iterable[PointCloud], frame: Frame = "map") -> PointCloud:
    """Concatenate clouds of one frame; attributes that one with points lacks are dropped."""
    parts = [cloud for cloud in clouds if len(cloud)]
    if not parts:
        return PointCloud(np.zeros((0, 3), np.float32), frame=frame)
    names = [field.name for field in fields(PointCloud) if field.name != "frame"]
    columns = {name: [getattr(cloud, name) for cloud in parts] for name in names}
    shared = {
        name: np.concatenate(arrays)
        for name, arrays in columns.items()
        if all(array is not None for array in arrays)
    }
    return PointCloud(**shared, frame=frame)
