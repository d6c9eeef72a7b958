"""Figures that an evaluation gives."""

from __future__ import annotations

from dataclasses import dataclass, field


@dataclass(frozen=True)
class LengthErrors:
    """Relative errors of the segments of one length.

    Attributes:
        length_m: Their length.
        t_rel_percent: Mean translation error, per cent of the length.
        r_rel_deg_per_100m: Mean rotation error.
        segments: How many.
    """

    length_m: float
    t_rel_percent: float
    r_rel_deg_per_100m: float
    segments: int


@dataclass(frozen=True)
class TrajectoryMetrics:
    """How far an estimated trajectory is from the true one.

    Attributes:
        t_rel_percent: Mean relative translation error over all segments, per cent (KITTI).
        r_rel_deg_per_100m: Mean relative rotation error over all segments (KITTI).
        ate_m: Root mean square distance of positions after the alignment.
        rpe_m: Root mean square translation error from each frame to the next.
        rpe_deg: Root mean square rotation error from each frame to the next.
        path_length_m: Length of the true path.
        frames: Number of poses compared.
        segment_lengths_m: Lengths of the segments used for the relative errors.
        segments: Number of segments.
        alignment: What was done to the estimate first: ``none``, ``origin``, ``se3``, ``sim3``.
        scale: Factor on the estimate's lengths in that.
        ate_median_m: Median distance of positions after the alignment.
        ate_max_m: Largest one.
        by_length: The relative errors for each length of segment.
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
    """How far a cloud is from a reference cloud.

    Attributes:
        threshold_m: Distance below which a point counts as right.
        precision: Share of estimated points within the threshold of the reference.
        recall: Share of reference points within the threshold of the estimate.
        f_score: Harmonic mean of the two.
        median_m: Median distance from estimated points to the reference.
        p95_m: 95th percentile of the same.
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
    """How right and how complete occupied voxels are.

    Attributes:
        precision: Share of the occupied voxels with a true surface within the tolerance.
        recall: Share of the true surface voxels with an occupied one within the tolerance.
        voxels: Occupied voxels compared.
        true_voxels: True voxels compared.
    """

    precision: float
    recall: float
    voxels: int
    true_voxels: int


@dataclass(frozen=True)
class GridMetrics:
    """How well a flat grid covers the true one, over the cells that were seen.

    Attributes:
        iou_occupied: Intersection over union of the occupied cells.
        iou_free: The same of the free cells.
        occupied_called_free: Share of the truly occupied cells that the grid calls free.
        unknown: Share of the cells compared that the grid does not know.
        cells: Cells compared.
        true_occupied: Truly occupied ones among them.
    """

    iou_occupied: float
    iou_free: float
    occupied_called_free: float
    unknown: float
    cells: int
    true_occupied: int


@dataclass(frozen=True)
class OccupancyMetrics:
    """How far an occupancy map is from the truth, with and without a tolerance of one cell.

    Attributes:
        resolution_m: Edge of a cell.
        least_frames: Frames that must have seen what is counted.
        voxels: In space, within one cell.
        voxels_exact: In space, the very cell.
        grid: On the ground, within one cell.
        grid_exact: On the ground, the very cell.
    """

    resolution_m: float
    least_frames: int
    voxels: VoxelMetrics
    voxels_exact: VoxelMetrics
    grid: GridMetrics
    grid_exact: GridMetrics


@dataclass(frozen=True)
class DisparityMetrics:
    """How far a disparity map is from the truth, over the pixels whose truth is known.

    Attributes:
        bad: Share of all pixels (per cent) that have a value off by more than the key, in pixels.
        invalid: Share of all pixels (per cent) without a value.
        avgerr_px: Mean absolute error of the pixels with a value.
        rms_px: Root mean square error of the same.
        pixels: Number of pixels compared.
        quantiles_px: Absolute error that so many per cent (the key) of the pixels with a value do
            not exceed: Middlebury's A50, A90, A95 and A99.
        d1: Share of all pixels (per cent) that have a value off by more than 3 pixels and more
            than 5 % of the truth: KITTI's outliers.
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
    """What the errors of a disparity map mean in depth, over pixels with a value and a truth.

    Attributes:
        mean_m: Mean absolute error of the depth.
        median_m: Median of the same.
        rms_m: Root mean square of the same.
        median_percent: Median absolute error, per cent of the true depth.
        over_5_percent: Share of those pixels (per cent) off by more than 5 % of the true depth.
        infinite: Share of those pixels (per cent) whose disparity gives no finite depth; they
            count in the median and in ``over_5_percent``, not in ``mean_m`` and ``rms_m``.
    """

    mean_m: float
    median_m: float
    rms_m: float
    median_percent: float
    over_5_percent: float
    infinite: float
