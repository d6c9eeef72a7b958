"""Ground truth, where a source has it."""

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
        nonocc: bool (H, W), True where the point is seen by both cameras.
    """

    values: Float32
    nonocc: Bool

    def __post_init__(self) -> None:
        freeze(self, "values", np.float32, (None, None))
        freeze(self, "nonocc", np.bool_, self.values.shape)


@dataclass(frozen=True, eq=False)
class SequenceTruth:
    """Truth of a drive; each part may be unknown (None).

    Attributes:
        trajectory: True poses, one per frame; the first is the identity.
        surface: Points on the true surfaces, frame ``world``.
    """

    trajectory: Trajectory | None = None
    surface: PointCloud | None = None


@dataclass(frozen=True, eq=False)
class OccupancyTruth:
    """What is really occupied, and what of it a drive saw; map axes.

    Attributes:
        grid: OCCUPIED where an obstacle reaches into the height band, else FREE; what is taller
            than the band, such as a house, is hollow.
        seen: bool, the shape of the grid: in ``least_frames`` frames some pixel looked at a
            surface in this cell, at or below the top of the band.
        keys: int32 (N, 3), cells of the grid's resolution that hold a surface which was seen.
        frames: int32 (N,), number of frames that saw it from within ``range_m``.
        camera: The rectified camera.
        T_map_camera: float64 (F, 4, 4), where it really was.
        range_m: Distance from the camera up to which a frame sees.
        least_frames: Frames that must have seen what is counted.
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
