"""Ground truth, for sources that have it."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Final

import numpy as np
from numpy.typing import ArrayLike
from typing_extensions import Self

from recon.core.errors import ShapeError
from recon.core.values.arrays import (
    Bool,
    Float32,
    Float64,
    Int32,
    float_map,
    freeze,
    map_text,
    size_text,
)
from recon.core.values.camera import RectifiedCamera
from recon.core.values.cloud import PointCloud
from recon.core.values.grid import OccupancyGrid
from recon.core.values.trajectory import Trajectory

_SEEN_BY_BOTH: Final = 255


@dataclass(frozen=True, eq=False)
class DisparityTruth:
    """True disparity of the left view.

    Attributes:
        values: float32 (H, W), pixels; NaN = unknown.
        nonocc: bool (H, W), True where both cameras see the point (not occluded).
    """

    values: Float32
    nonocc: Bool

    def __post_init__(self) -> None:
        freeze(self, "values", np.float32, (None, None))
        freeze(self, "nonocc", np.bool_, self.values.shape)

    @classmethod
    def from_values(cls, values: ArrayLike, nonocc: ArrayLike | None = None) -> Self:
        """Build a ground truth from a bare array.

        Args:
            values: (H, W) of any real dtype, pixels; NaN, infinite, zero and negative values are
                unknown.
            nonocc: bool (H, W), True where both cameras see the point, or the levels of a mask of
                Middlebury, 255 there; None = both see everything.

        Raises:
            ShapeError: An array has the wrong shape or dtype.
        """
        found = float_map("truth", values)
        known = np.isfinite(found) & (found > 0)
        seen = known if nonocc is None else known & _seen_by_both(nonocc, found.shape)
        return cls(np.where(known, found, np.float32(np.nan)), seen)

    def __repr__(self) -> str:
        size, seen = size_text(self.values), 100 * float(np.mean(self.nonocc))
        return f"DisparityTruth({size}, {map_text(self.values)} known, {seen:.1f} % not occluded)"


def _seen_by_both(mask: ArrayLike, shape: tuple[int, ...]) -> Bool:
    """Return bool (H, W), from truth values or from Middlebury's levels (128 = occluded)."""
    levels = np.asarray(mask)
    seen = levels if levels.dtype == np.bool_ else levels == _SEEN_BY_BOTH
    if levels.shape != shape or (levels.dtype != np.bool_ and not seen.any()):
        raise ShapeError(
            "nonocc is no mask of the truth",
            got=f"{levels.dtype} {levels.shape}",
            expected=f"bool {shape}, or levels with {_SEEN_BY_BOTH} where both cameras see",
        )
    return np.asarray(seen)


@dataclass(frozen=True, eq=False)
class SequenceTruth:
    """Ground truth of a drive; each part may be unknown (None).

    Attributes:
        trajectory: True poses, one per frame; the first is the identity.
        surface: Points on the true surfaces, frame ``world``.
    """

    trajectory: Trajectory | None = None
    surface: PointCloud | None = None


@dataclass(frozen=True, eq=False)
class OccupancyTruth:
    """True occupancy, and which part of it a drive saw; map axes.

    Attributes:
        grid: OCCUPIED where an obstacle reaches into the height band, else FREE; obstacles taller
            than the band, such as houses, are hollow.
        seen: bool, same shape as the grid: True where at least ``least_frames`` frames saw a
            surface in the cell, at or below the top of the band.
        keys: int32 (N, 3), voxels at the resolution of the grid that contain a seen surface.
        frames: int32 (N,), number of frames that saw each voxel from within ``range_m``.
        camera: The rectified camera.
        T_map_camera: float64 (F, 4, 4), true poses of the camera.
        range_m: Maximum distance from the camera at which a surface counts as seen.
        least_frames: Minimum number of frames that must have seen what is counted.
    """

    grid: OccupancyGrid
    seen: Bool
    keys: Int32
    frames: Int32
    camera: RectifiedCamera
    T_map_camera: Float64
    range_m: float
    least_frames: int

    def __post_init__(self) -> None:
        freeze(self, "seen", np.bool_, self.grid.cells.shape)
        freeze(self, "keys", np.int32, (None, 3))
        freeze(self, "frames", np.int32, (len(self.keys),))
        freeze(self, "T_map_camera", np.float64, (None, 4, 4))
