"""How well a calibration describes the views of its board, and what depth to expect of it."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field

from recon.core.summary import Figures


@dataclass(frozen=True)
class DepthErrorCm(Figures):
    """Depth error at a distance, in centimetres; None = there is no common view."""

    calibration: float | None  # due to the calibration
    low: float | None  # in the middle of the image
    high: float | None
    matching: float  # due to matching


@dataclass(frozen=True)
class WorkingError(Figures):
    """Depth error at the distance that the rig is for, as fractions of that distance."""

    distance_m: float
    calibration_ratio: float | None  # None = there is no common view
    matching_ratio: float


@dataclass(frozen=True, kw_only=True)
class CalibrationFigures(Figures):
    """How well a rig describes the views of the board, and what to expect of it."""

    board: str
    width_px: int
    height_px: int
    stereo_rms_px: float
    left_rms_px: float  # of the camera alone
    right_rms_px: float
    epipolar_px: float  # epipolar error after rectification, mean and 95th percentile
    epipolar_95_px: float
    baseline_m: float
    baseline_interval_m: Sequence[float]  # of the bootstrap, 95 %
    baseline_squares: float
    focal_px: float
    focal_interval_px: Sequence[float]
    focal_right_px: float
    rotation_spread_deg: float
    views: int
    views_used: int
    views_repeated: Sequence[str]
    views_dropped: Sequence[str]
    dropped_error_px: Mapping[str, float]
    pictures_without_board: Sequence[str]
    view_errors_px: Mapping[str, Sequence[float]]  # left and right
    coverage_left: float  # fraction of image cells in which a corner was seen
    coverage_right: float
    tilt_max_deg: float
    tilted_ratio: float  # fraction of the views that are tilted enough
    far_to_near: float  # distance of the farthest view, divided by that of the nearest
    depth_error_cm: Mapping[str, DepthErrorCm]  # by distance in metres
    working_error: WorkingError
    rectified_focal_px: float
    held_out_px: Mapping[str, float] = field(
        default_factory=dict
    )  # of views left out, by lens model
