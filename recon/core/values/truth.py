"""Ground truth, for sources that have it, and the results of comparing with it."""

from __future__ import annotations

from dataclasses import dataclass, field
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
    range_text,
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
        """Build a ground truth from an array (H, W), any real dtype, pixels; above 0 = known.

        ``nonocc`` is bool (H, W), True where both cameras see the point, or the levels of a mask of
        Middlebury (255 there, 128 = occluded); None = both see everything. Others are a
        `ShapeError`.
        """
        found = float_map("truth", values)
        seen = known = np.isfinite(found) & (found > 0)
        if nonocc is not None:
            mask = np.asarray(nonocc)
            shown = mask if mask.dtype == np.bool_ else mask == _SEEN_BY_BOTH
            if mask.shape != found.shape or (mask.dtype != np.bool_ and not shown.any()):
                raise ShapeError(
                    "nonocc is not a mask of the ground truth",
                    got=f"{mask.dtype} {mask.shape}",
                    expected=f"bool {found.shape}, or levels, {_SEEN_BY_BOTH} where both see",
                )
            seen = known & shown
        return cls(np.where(known, found, np.float32(np.nan)), seen)

    def __repr__(self) -> str:
        known, seen = (100 * float(np.mean(m)) for m in (np.isfinite(self.values), self.nonocc))
        ratios = f"{known:.1f} % known, {seen:.1f} % not occluded"
        return f"DisparityTruth({size_text(self.values)}, {range_text(self.values)}{ratios})"


@dataclass(frozen=True, eq=False)
class SequenceTruth:
    """Ground truth of a drive; each part may be unknown (None)."""

    trajectory: Trajectory | None = None  # true poses, one per frame; the first is the identity
    surface: PointCloud | None = None  # points on the true surfaces, frame ``world``


@dataclass(frozen=True, eq=False)
class OccupancyTruth:
    """True occupancy, and which part of it a drive saw; map axes."""

    # OCCUPIED where an obstacle reaches into the height band, else FREE; obstacles taller than the
    # band, such as houses, are hollow
    grid: OccupancyGrid
    # bool, same shape as the grid: True where at least ``least_frames`` frames saw a surface in the
    # cell, at or below the top of the band
    seen: Bool
    keys: Int32  # int32 (N, 3), voxels at the resolution of the grid that contain a seen surface
    frames: Int32  # int32 (N,), number of frames that saw each voxel from within ``range_m``
    camera: RectifiedCamera  # the rectified camera
    T_map_camera: Float64  # (F, 4, 4), true poses of the camera
    range_m: float  # maximum distance from the camera at which a surface counts as seen
    least_frames: int  # minimum number of frames that must have seen what is counted

    def __post_init__(self) -> None:
        freeze(self, "seen", np.bool_, self.grid.cells.shape)
        freeze(self, "keys", np.int32, (None, 3))
        freeze(self, "frames", np.int32, (len(self.keys),))
        freeze(self, "T_map_camera", np.float64, (None, 4, 4))


@dataclass(frozen=True)
class LengthErrors:
    """Relative errors over the path segments of one length."""

    length_m: float  # length of the segments
    t_rel_percent: float  # mean translation error, per cent of the length
    r_rel_deg_per_100m: float  # mean rotation error
    segments: int  # number of segments


@dataclass(frozen=True)
class TrajectoryMetrics:
    """Errors of an estimated trajectory with respect to ground truth."""

    t_rel_percent: float  # mean relative translation error over all segments, per cent (KITTI)
    r_rel_deg_per_100m: float  # mean relative rotation error over all segments (KITTI)
    ate_m: float  # root mean square distance of positions after alignment (ATE)
    rpe_m: float  # root mean square translation error from each frame to the next (RPE)
    rpe_deg: float  # root mean square rotation error from each frame to the next (RPE)
    path_length_m: float  # length of the true path
    frames: int  # number of poses compared
    segment_lengths_m: tuple[float, ...]  # lengths of the segments used for the relative errors
    segments: int  # number of segments
    # how the estimate was aligned: ``none``, ``origin``, ``se3``, ``sim3``, ``upright``
    alignment: str = "se3"
    scale: float = 1.0  # scale factor applied to the estimate in the alignment
    ate_median_m: float = float("nan")  # median distance of positions after alignment
    ate_max_m: float = float("nan")  # largest distance of positions after alignment
    by_length: tuple[LengthErrors, ...] = ()  # relative errors for each segment length


@dataclass(frozen=True)
class MapMetrics:
    """Accuracy and completeness of a cloud with respect to a reference cloud."""

    threshold_m: float  # distance below which a point counts as correct
    precision: float  # fraction of estimated points within the threshold of the reference
    recall: float  # fraction of reference points within the threshold of the estimate
    f_score: float  # harmonic mean of precision and recall
    median_m: float  # median distance from estimated points to the reference
    p95_m: float  # 95th percentile of that distance
    points: int  # number of estimated points compared
    reference_points: int  # number of reference points compared


@dataclass(frozen=True)
class VoxelMetrics:
    """Accuracy and completeness of occupied voxels."""

    precision: (
        float  # fraction of the occupied voxels with a true surface voxel within the tolerance
    )
    recall: float  # fraction of the true surface voxels with an occupied voxel within the tolerance
    voxels: int  # number of occupied voxels compared
    true_voxels: int  # number of true surface voxels compared


@dataclass(frozen=True)
class GridMetrics:
    """Agreement of a 2-D grid with the true one, over the cells that were seen."""

    iou_occupied: float  # intersection over union of the occupied cells
    iou_free: float  # intersection over union of the free cells
    occupied_called_free: float  # fraction of the truly occupied cells that the grid marks as free
    unknown: float  # fraction of the compared cells that are unknown in the grid
    cells: int  # number of cells compared
    true_occupied: int  # number of those that are truly occupied


@dataclass(frozen=True)
class OccupancyMetrics:
    """Agreement of an occupancy map with the truth, with and without a tolerance of one cell."""

    resolution_m: float  # cell size of voxels and grid
    least_frames: int  # minimum number of frames that must have seen what is counted
    voxels: VoxelMetrics  # voxels, with a tolerance of one cell
    voxels_exact: VoxelMetrics  # voxels, without tolerance
    grid: GridMetrics  # 2-D grid, with a tolerance of one cell
    grid_exact: GridMetrics  # 2-D grid, without tolerance


@dataclass(frozen=True)
class DisparityMetrics:
    """Errors of a disparity map, over the pixels whose true disparity is known."""

    bad: dict[float, float]  # fraction of all pixels (per cent) off by more than so many (key)
    invalid: float  # fraction of all pixels (per cent) without a value
    avgerr_px: float  # mean absolute error of the pixels with a value
    rms_px: float  # root mean square error of the pixels with a value
    pixels: int  # number of pixels compared
    # percentiles (key) of the absolute error of pixels with a value: Middlebury's A50 to A99
    quantiles_px: dict[int, float] = field(default_factory=dict)
    # fraction of all pixels (per cent) off by more than 3 pixels and 5 % of the truth: KITTI's D1
    d1: float = float("nan")


@dataclass(frozen=True)
class DepthMetrics:
    """Depth errors of a disparity map, over the pixels with both a value and a true disparity."""

    mean_m: float  # mean absolute error of the depth
    median_m: float  # median absolute error of the depth
    rms_m: float  # root mean square error of the depth
    median_percent: float  # median absolute error, per cent of the true depth
    over_5_percent: float  # fraction of the pixels (per cent) off by more than 5 % of the depth
    # fraction of the pixels (per cent) without a finite depth: not in ``mean_m`` and ``rms_m``
    infinite: float
