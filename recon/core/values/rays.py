"""Rays of one frame: its evidence of free and occupied space, compact enough to keep per frame."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Final

import numpy as np
from numpy.typing import NDArray

from recon.core.values.arrays import UInt8, freeze
from recon.core.values.cloud import PointCloud
from recon.core.words import counted

_CERTAIN: Final = 255


@dataclass(frozen=True)
class RayGrain:
    """Resolution of stored rays.

    Attributes:
        cell_m: Edge length of the cubes in which points are averaged.
        unit_m: Quantisation step of the end points.
        max_range_m: Points farther away are moved along their rays to just beyond this range.
    """

    cell_m: float
    unit_m: float
    max_range_m: float


@dataclass(frozen=True, eq=False)
class RayCloud:
    """Rays of one frame, from the camera to the observed points, in camera axes.

    Attributes:
        places: int16 (N, 3), end points of the rays, multiples of ``unit_m``.
        sigma_m: float16 (N,), standard deviation of the depth.
        confidence: uint8 (N,), 255 = certain.
        count: uint8 (N,), number of averaged points; 255 = 255 or more.
        unit_m: Quantisation step of ``places``.
    """

    places: NDArray[np.int16]
    sigma_m: NDArray[np.float16]
    confidence: UInt8
    count: UInt8
    unit_m: float

    def __post_init__(self) -> None:
        freeze(self, "places", np.int16, (None, 3))
        freeze(self, "sigma_m", np.float16, (len(self.places),))
        freeze(self, "confidence", np.uint8, (len(self.places),))
        freeze(self, "count", np.uint8, (len(self.places),))

    def __repr__(self) -> str:
        return f"RayCloud({counted(len(self), 'ray')})"

    def __len__(self) -> int:
        return len(self.places)

    def cloud(self) -> PointCloud:
        """Return the end points as a cloud; ``count`` is the number of averaged points."""
        return PointCloud(
            self.places * np.float32(self.unit_m),
            sigma_m=self.sigma_m.astype(np.float32),
            confidence=self.confidence / np.float32(_CERTAIN),
            count=self.count.astype(np.int32),
        )
