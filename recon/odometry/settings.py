"""Settings of the odometries, summed in `OdometrySettings`."""

from __future__ import annotations

from typing import Literal

from pydantic import Field

from recon.settings import Settings


class CornerSettings(Settings):
    """Which corners are followed."""

    cell_px: int = Field(40, ge=8, le=1024, description="Edge of a cell of the picture")
    per_cell: int = Field(3, ge=1, le=100, description="Corners that a cell may hold")
    distance_px: int = Field(6, ge=1, le=100, description="Least distance between two corners")
    block_px: int = Field(5, ge=3, le=31, description="Neighbourhood of the corner score")
    min_score: float = Field(
        2e-4, ge=0.0, description="Least eigenvalue of the gradients' covariance, OpenCV's scale"
    )
    border_px: int = Field(8, ge=0, le=200, description="Corners nearer to the border are left")


class TrackSettings(Settings):
    """How corners are followed to the next picture and to the other eye."""

    window_px: int = Field(17, ge=5, le=63, description="Edge of the tracked patch")
    levels: int = Field(3, ge=0, le=8, description="Picture sizes below full size")
    max_return_px: float = Field(
        0.5, gt=0.0, le=10.0, description="Largest distance of forward plus backward tracking"
    )
    neighbour_px: int = Field(
        2, ge=0, le=20, description="Half size of the neighbourhood that gives a disparity"
    )
    max_disparity_step_px: float = Field(
        1.0, gt=0.0, le=20.0, description="Largest difference of a disparity to its neighbours"
    )
    min_eigenvalue: float = Field(
        1e-4, ge=0.0, description="Least texture of a patch that is followed, OpenCV's scale"
    )


class WindowSettings(Settings):
    """How the poses of the last frames and the points in them are adjusted together."""

    frames: int = Field(6, ge=2, le=30, description="Frames adjusted together")
    iterations: int = Field(6, ge=1, le=100, description="Levenberg-Marquardt steps at most")
    min_gain: float = Field(
        1e-3, gt=0.0, lt=1.0, description="Relative gain of a step below which it is the last"
    )
    sigma_uv_px: float = Field(0.3, gt=0.0, description="Standard deviation of a track")
    sigma_d_px: float = Field(
        1.5,
        gt=0.0,
        description="Standard deviation of a disparity; its error stays with a feature from frame "
        "to frame and does not average out, so it counts less than one of its own would",
    )
    cauchy_sigmas: float = Field(
        3.0, gt=0.0, description="Residual at which an observation counts half"
    )
    max_sigmas: float = Field(
        6.0, gt=0.0, description="Residual above which an observation ends its track"
    )


class PoseSettings(Settings):
    """When tracks give a pose."""

    reprojection_px: float = Field(2.0, gt=0.0, le=20.0, description="RANSAC's inlier limit")
    iterations: int = Field(200, ge=10, le=10000, description="RANSAC's samples at most")
    min_inliers: int = Field(15, ge=6, description="Fewer agreeing tracks give no pose")
    min_inlier_share: float = Field(
        0.3, gt=0.0, le=1.0, description="A smaller share of agreeing tracks gives no pose"
    )
    min_disparity_px: float = Field(
        0.5, gt=0.0, description="Features with less disparity are left: their depth is unknown"
    )


class VisualSettings(Settings):
    """Visual odometry: corners, tracks, pose, window."""

    corners: CornerSettings = CornerSettings()
    tracks: TrackSettings = TrackSettings()
    pose: PoseSettings = PoseSettings()
    window: WindowSettings = WindowSettings()
