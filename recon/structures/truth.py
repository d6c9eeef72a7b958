"""Ground truth, for sources that have it."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from recon.structures.arrays import Bool, Float32, Float64, Int32, freeze
from recon.structures.camera import RectifiedCamera
from recon.structures.cloud import PointCloud
from recon.structures.grid import OccupancyGrid
from recon.structures.trajectory import Trajectory


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
