"""Ground truth, for sources that have it."""

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


@dataclass(frozen=True)
class LengthErrors:
    """Relative errors over the path segments of one length.

    Attributes:
        length_m: Length of the segments.
        t_rel_percent: Mean translation error, per cent of the length.
        r_rel_deg_per_100m: Mean rotation error.
        segments: Number of segments.
    """

    length_m: float
    t_rel_percent: float
    r_rel_deg_per_100m: float
    segments: int


@dataclass(frozen=True)
class TrajectoryMetrics:
    """Errors of an estimated trajectory with respect to ground truth.

    Attributes:
        t_rel_percent: Mean relative translation error over all segments, per cent (KITTI).
        r_rel_deg_per_100m: Mean relative rotation error over all segments (KITTI).
        ate_m: Root mean square distance of positions after alignment (ATE).
        rpe_m: Root mean square translation error from each frame to the next (RPE).
        rpe_deg: Root mean square rotation error from each frame to the next (RPE).
        path_length_m: Length of the true path.
        frames: Number of poses compared.
        segment_lengths_m: Lengths of the segments used for the relative errors.
        segments: Number of segments.
        alignment: How the estimate was aligned: ``none``, ``origin``, ``se3``, ``sim3``,
            ``upright``.
        scale: Scale factor applied to the estimate in the alignment.
        ate_median_m: Median distance of positions after alignment.
        ate_max_m: Largest distance of positions after alignment.
        by_length: Relative errors for each segment length.
    """

    t_rel_percent: float
    r_rel_deg_per_100m: float
    ate_m: float
    rpe_m: float
    rpe_deg: float
    path_length_m: float
    frames: int
    segment_lengths_m: tuple[float, ...]
    segments: int
    alignment: str = "se3"
    scale: float = 1.0
    ate_median_m: float = float("nan")
    ate_max_m: float = float("nan")
    by_length: tuple[LengthErrors, ...] = ()


@dataclass(frozen=True)
class MapMetrics:
    """Accuracy and completeness of a cloud with respect to a reference cloud.

    Attributes:
        threshold_m: Distance below which a point counts as correct.
        precision: Share of estimated points within the threshold of the reference.
        recall: Share of reference points within the threshold of the estimate.
        f_score: Harmonic mean of precision and recall.
        median_m: Median distance from estimated points to the reference.
        p95_m: 95th percentile of that distance.
        points: Number of estimated points compared.
        reference_points: Number of reference points compared.
    """

    threshold_m: float
    precision: float
    recall: float
    f_score: float
    median_m: float
    p95_m: float
    points: int
    reference_points: int


@dataclass(frozen=True)
class VoxelMetrics:
    """Accuracy and completeness of occupied voxels.

    Attributes:
        precision: Share of the occupied voxels with a true surface voxel within the tolerance.
        recall: Share of the true surface voxels with an occupied voxel within the tolerance.
        voxels: Number of occupied voxels compared.
        true_voxels: Number of true surface voxels compared.
    """

    precision: float
    recall: float
    voxels: int
    true_voxels: int


@dataclass(frozen=True)
class GridMetrics:
    """Agreement of a 2-D grid with the true one, over the cells that were seen.

    Attributes:
        iou_occupied: Intersection over union of the occupied cells.
        iou_free: Intersection over union of the free cells.
        occupied_called_free: Share of the truly occupied cells that the grid marks as free.
        unknown: Share of the compared cells that are unknown in the grid.
        cells: Number of cells compared.
        true_occupied: Number of those that are truly occupied.
    """

    iou_occupied: float
    iou_free: float
    occupied_called_free: float
    unknown: float
    cells: int
    true_occupied: int


@dataclass(frozen=True)
class OccupancyMetrics:
    """Agreement of an occupancy map with the truth, with and without a tolerance of one cell.

    Attributes:
        resolution_m: Cell size of voxels and grid.
        least_frames: Minimum number of frames that must have seen what is counted.
        voxels: Voxels, with a tolerance of one cell.
        voxels_exact: Voxels, without tolerance.
        grid: 2-D grid, with a tolerance of one cell.
        grid_exact: 2-D grid, without tolerance.
    """

    resolution_m: float
    least_frames: int
    voxels: VoxelMetrics
    voxels_exact: VoxelMetrics
    grid: GridMetrics
    grid_exact: GridMetrics


@dataclass(frozen=True)
class DisparityMetrics:
    """Errors of a disparity map, over the pixels whose true disparity is known.

    Attributes:
        bad: For each threshold in pixels (key), share of all pixels (per cent) whose value has a
            larger error.
        invalid: Share of all pixels (per cent) without a value.
        avgerr_px: Mean absolute error of the pixels with a value.
        rms_px: Root mean square error of the pixels with a value.
        pixels: Number of pixels compared.
        quantiles_px: Percentiles (key: per cent) of the absolute error of the pixels with a
            value: Middlebury's A50, A90, A95 and A99.
        d1: Share of all pixels (per cent) whose value has an error above 3 pixels and above 5 %
            of the true disparity: KITTI's D1.
    """

    bad: dict[float, float]
    invalid: float
    avgerr_px: float
    rms_px: float
    pixels: int
    quantiles_px: dict[int, float] = field(default_factory=dict)
    d1: float = float("nan")


@dataclass(frozen=True)
class DepthMetrics:
    """Depth errors of a disparity map, over the pixels with both a value and a true disparity.

    Attributes:
        mean_m: Mean absolute error of the depth.
        median_m: Median absolute error of the depth.
        rms_m: Root mean square error of the depth.
        median_percent: Median absolute error, per cent of the true depth.
        over_5_percent: Share of the pixels (per cent) with an error above 5 % of the true depth.
        infinite: Share of the pixels (per cent) whose disparity gives no finite depth; they count
            in the median and in ``over_5_percent``, but not in ``mean_m`` and ``rms_m``.
    """

    mean_m: float
    median_m: float
    rms_m: float
    median_percent: float
    over_5_percent: float
    infinite: float
