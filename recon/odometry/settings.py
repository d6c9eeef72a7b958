"""Settings of the odometries, summed in `OdometrySettings`."""

from __future__ import annotations

from typing import Literal

from pydantic import Field

from recon.core.settings import Settings


class CornerSettings(Settings):
    """Which corners are followed."""

    cell_px: int = Field(40, ge=8, le=1024, description="Edge of a cell of the picture.")
    per_cell: int = Field(3, ge=1, le=100, description="Corners that a cell may hold.")
    distance_px: int = Field(6, ge=1, le=100, description="Least distance between two corners.")
    block_px: int = Field(
        5,
        ge=3,
        le=31,
        description="Edge of the neighbourhood that the corner score is computed in.",
    )
    min_score: float = Field(
        2e-4, ge=0.0, description="Least eigenvalue of the gradients' covariance, OpenCV's scale."
    )
    border_px: int = Field(
        8, ge=0, le=200, description="Corners nearer to the border are not used."
    )


class TrackSettings(Settings):
    """How corners are tracked to the next picture, and what disparity they get."""

    window_px: int = Field(17, ge=5, le=63, description="Edge of the tracked patch.")
    levels: int = Field(3, ge=0, le=8, description="Pyramid levels above full resolution.")
    return_levels: int = Field(
        0,
        ge=0,
        le=8,
        description="Pyramid levels for tracking back. It starts where it should end, so that "
        "it only has to stay there.",
    )
    max_exposure_change: float = Field(
        0.05,
        ge=0.0,
        description="Relative change of brightness or contrast above which a picture is adapted to "
        "the exposure of the last one before tracking.",
    )
    max_return_px: float = Field(
        0.5,
        gt=0.0,
        le=10.0,
        description="Largest distance between a feature and where tracking forth and back ends.",
    )
    neighbour_px: int = Field(
        2, ge=0, le=20, description="Half width of the neighbourhood whose median is the disparity."
    )
    max_disparity_step_px: float = Field(
        1.0, gt=0.0, le=20.0, description="Largest difference between a disparity and that median."
    )
    min_eigenvalue: float = Field(
        1e-4, ge=0.0, description="Least texture of a patch that is tracked, OpenCV's scale."
    )


class WindowSettings(Settings):
    """Bundle adjustment of the poses of the last frames and the points in them."""

    frames: int = Field(6, ge=2, le=30, description="Frames adjusted together.")
    iterations: int = Field(6, ge=1, le=100, description="Levenberg-Marquardt steps at most.")
    min_gain: float = Field(
        1e-3,
        gt=0.0,
        lt=1.0,
        description="Relative decrease of the cost below which a step is the last.",
    )
    independence: float = Field(
        0.25, gt=0.0, le=1.0, description="Share of the tracks whose errors count as independent."
    )
    sigma_uv_px: float = Field(
        0.3, gt=0.0, description="Standard deviation of a tracked column or row."
    )
    sigma_d_px: float = Field(
        1.5,
        gt=0.0,
        description="Standard deviation of a disparity; larger than that of a single match, "
        "because its error stays with a feature from frame to frame and does not average out.",
    )
    cauchy_sigmas: float = Field(
        3.0, gt=0.0, description="Residual at which the weight of an observation is one half."
    )
    max_sigmas: float = Field(
        6.0, gt=0.0, description="Residual above which an observation ends its track."
    )


class PoseSettings(Settings):
    """How a pose is found from tracks, and how many must agree on it."""

    reprojection_px: float = Field(2.0, gt=0.0, le=20.0, description="RANSAC's inlier limit.")
    iterations: int = Field(200, ge=10, le=10000, description="RANSAC's samples at most.")
    min_inliers: int = Field(15, ge=6, description="Fewer agreeing tracks give no pose.")
    min_inlier_share: float = Field(
        0.3, gt=0.0, le=1.0, description="A smaller share of agreeing tracks gives no pose."
    )
    min_disparity_px: float = Field(
        0.5, gt=0.0, description="Features with less disparity count as without depth."
    )


class AgreementSettings(Settings):
    """How a motion is checked against the whole picture, patch by patch."""

    stride_px: int = Field(5, ge=1, le=32, description="Every n-th row and column is sampled.")
    patch_px: int = Field(48, ge=8, le=512, description="Edge of a patch.")
    min_pixels: int = Field(
        24, ge=4, description="Least number of samples with a disparity in a patch."
    )
    min_texture: float = Field(
        3.0,
        gt=0.0,
        description="A patch is used if its mean squared gradient, in the direction in which it is "
        "smallest, exceeds that of the noise by this factor.",
    )
    min_correlation: float = Field(
        0.6, gt=0.0, lt=1.0, description="Least correlation of a patch that agrees."
    )
    min_telling: int = Field(
        8, ge=1, description="With fewer usable patches the check says nothing."
    )
    min_share: float = Field(
        0.6,
        gt=0.0,
        lt=1.0,
        description="Least share of patches that must agree with a trusted motion.",
    )


class TrustSettings(Settings):
    """Which poses are trusted; frames with others do not go into the map."""

    max_sigma_m: float = Field(
        0.05, gt=0.0, description="Largest standard deviation of a trusted motion."
    )
    max_sigma_share: float = Field(
        0.05, ge=0.0, description="Share of the motion's length that is added to `max_sigma_m`."
    )
    agreement: AgreementSettings = AgreementSettings()


class PriorSettings(Settings):
    """How a path from other sensors is used."""

    axes: Literal["auto", "camera", "body"] = Field(
        "auto",
        description="Axes of its poses: of the left camera (x right, y down, z forward), or of a "
        "body (x forward, y left, z up) that turns with it and is near to it. auto = those in "
        "which it explains what the cameras see on the first metres.",
    )
    max_gap_s: float = Field(
        1.0, gt=0.0, description="Poses farther apart in time are not interpolated."
    )
    sigma_m: float = Field(
        0.03, gt=0.0, description="Standard deviation of its motion from frame to frame."
    )
    sigma_share: float = Field(
        0.03, ge=0.0, description="Share of the motion's length that is added to `sigma_m`."
    )
    sigma_deg: float = Field(
        0.5, gt=0.0, description="Standard deviation of its rotation from frame to frame."
    )
    max_sigmas: float = Field(
        4.7,
        gt=0.0,
        description="A visual motion farther from that of the path, in standard deviations of "
        "their difference, is rejected.",
    )


class VisualSettings(Settings):
    """Visual odometry: corners, tracks, pose, window."""

    corners: CornerSettings = CornerSettings()
    tracks: TrackSettings = TrackSettings()
    pose: PoseSettings = PoseSettings()
    window: WindowSettings = WindowSettings()
    relocate_features: int = Field(
        2000,
        ge=100,
        le=20000,
        description="Features matched over the whole picture where tracking fails.",
    )


class PointSettings(Settings):
    """Which pixels are aligned by ICP."""

    min_gradient: float = Field(
        100.0, ge=0.0, description="Least horizontal gradient, 3x3 Sobel of grey values."
    )
    max_disparity_step_px: float = Field(
        0.5, gt=0.0, description="Largest difference between a disparity and the median around it."
    )
    min_range_m: float = Field(1.0, ge=0.0, description="Nearer points are not used.")
    max_range_m: float = Field(30.0, gt=0.0, description="Farther points are not used.")
    max_sigma_m: float = Field(
        1.0, gt=0.0, description="Points with a less certain depth are not used."
    )


class KissSettings(Settings):
    """kiss-icp as it comes, on the whole cloud: for comparison."""

    max_range_m: float = Field(30.0, gt=0.0, description="Farther points are not used.")
    voxel_m: float = Field(0.5, gt=0.0, description="Edge of a voxel of the map.")
    initial_threshold_m: float = Field(
        2.0, gt=0.0, description="First value of the adaptive threshold."
    )
    min_motion_m: float = Field(
        0.1,
        gt=0.0,
        description="Deviations from the motion model below this do not change the threshold.",
    )
    min_points: int = Field(1000, ge=10, description="Frames with fewer points are skipped.")


class IcpSettings(Settings):
    """ICP of selected points against a local map, from the visual prior."""

    source_range_m: float = Field(
        24.0, gt=0.0, description="Farther points are not aligned, but go into the map."
    )
    voxel_m: float = Field(0.3, gt=0.0, description="Edge of a voxel of the map.")
    threshold_m: float = Field(
        0.3, gt=0.0, description="Scale of the robust kernel; points pair up to thrice as far."
    )
    lost_threshold_m: float = Field(
        1.0, gt=0.0, description="`threshold_m` where there is no visual prior."
    )
    iterations: int = Field(50, ge=1, description="ICP steps at most.")
    convergence: float = Field(
        1e-3, gt=0.0, description="Length of a step below which it is the last."
    )
    min_points: int = Field(
        300, ge=10, description="Frames with fewer points keep the visual pose."
    )
    every: int = Field(
        4,
        ge=1,
        description="ICP runs, and its map is updated, every n-th frame; in between only where the "
        "prior is uncertain enough for ICP to improve it.",
    )
    surface_m: float = Field(
        1.0, gt=0.0, description="Edge of the cells in which surfaces are fitted to the map."
    )


class GateSettings(Settings):
    """When an ICP correction is applied, and how much of it."""

    min_overlap: float = Field(
        0.5, ge=0.0, le=1.0, description="Least share of points that lie in a cell of the map."
    )
    min_residual_gain: float = Field(
        0.02, ge=0.0, lt=1.0, description="Least relative decrease of the median residual."
    )
    max_sigmas: float = Field(
        4.7,
        gt=0.0,
        description="Corrections farther from the prior, in standard deviations of their "
        "difference, are refused (4.7: 0.1 % of right ones, six degrees of freedom).",
    )
    min_share: float = Field(
        0.1,
        ge=0.0,
        le=1.0,
        description="Directions in which the Kalman gain is smaller are not corrected: there ICP "
        "knows no more than the prior.",
    )
    icp_independence: float = Field(
        0.05, gt=0.0, le=1.0, description="Share of the points whose errors count as independent."
    )
    icp_floor_m: float = Field(
        0.02,
        gt=0.0,
        description="Standard deviation of ICP's translation that more points do not improve.",
    )
    icp_floor_deg: float = Field(0.05, gt=0.0, description="That of its rotation.")
    lost_sigma_m: float = Field(
        0.05,
        gt=0.0,
        description="Standard deviation of an extrapolated translation, times the number of "
        "frames since the last visual motion.",
    )
    lost_sigma_deg: float = Field(
        0.3, gt=0.0, description="That of an extrapolated rotation, likewise."
    )
    offset_frames: int = Field(
        30,
        ge=1,
        description="Frames over which the mean ICP correction is estimated, and then subtracted: "
        "a constant one comes from the bias of stereo depth with range, not from the motion.",
    )


class FusedSettings(Settings):
    """Visual odometry with ICP corrections."""

    points: PointSettings = PointSettings()
    icp: IcpSettings = IcpSettings()
    gate: GateSettings = GateSettings()


OdometryName = Literal["visual", "kiss", "fused"]


class OdometrySettings(Settings):
    """The odometries: which one, and how each works."""

    method: OdometryName = Field("fused", description="visual, kiss or fused.")
    prior: PriorSettings = PriorSettings()
    trust: TrustSettings = TrustSettings()
    visual: VisualSettings = VisualSettings()
    kiss: KissSettings = KissSettings()
    fused: FusedSettings = FusedSettings()
