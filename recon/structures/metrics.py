"""Figures that an evaluation gives."""

from __future__ import annotations

from dataclasses import dataclass


@dataclass(frozen=True)
class TrajectoryMetrics:
    """How far an estimated trajectory is from the true one.

    Attributes:
        t_rel_percent: Mean relative translation error over all segments, per cent (KITTI).
        r_rel_deg_per_100m: Mean relative rotation error over all segments (KITTI).
        ate_m: Root mean square distance of positions after a rigid (SE(3)) alignment.
        rpe_m: Root mean square translation error from each frame to the next.
        rpe_deg: Root mean square rotation error from each frame to the next.
        path_length_m: Length of the true path.
        frames: Number of poses compared.
        segment_lengths_m: Lengths of the segments used for the relative errors.
        segments: Number of segments.
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
class DisparityMetrics:
    """How far a disparity map is from the truth, over the pixels whose truth is known.

    Attributes:
        bad: Share of all pixels (per cent) that have a value off by more than the key, in pixels.
        invalid: Share of all pixels (per cent) without a value.
        avgerr_px: Mean absolute error of the pixels with a value.
        rms_px: Root mean square error of the same.
        pixels: Number of pixels compared.
    """

    bad: dict[float, float]
    invalid: float
    avgerr_px: float
    rms_px: float
    pixels: int
