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
    return_levels: int = Field(
        0,
        ge=0,
        le=8,
        description="The same for the way back, which begins where it should end: it only has to "
        "tell whether it stays there",
    )
    max_exposure_change: float = Field(
        0.05,
        ge=0.0,
        description="Relative change of brightness or contrast from which a picture is brought to "
        "the exposure of the last one before features are followed",
    )
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
    independence: float = Field(
        0.25, gt=0.0, le=1.0, description="Share of tracks whose errors count as independent"
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


class AgreementSettings(Settings):
    """How the whole picture is asked whether a motion explains it."""

    stride_px: int = Field(5, ge=1, le=32, description="Every n-th row and column is looked at")
    patch_px: int = Field(48, ge=8, le=512, description="Edge of a patch")
    min_pixels: int = Field(24, ge=4, description="Pixels with a disparity that a patch needs")
    min_texture: float = Field(
        3.0,
        gt=0.0,
        description="A patch is asked if its grey values change, in the direction in which they "
        "change least, by so much more than noise makes them (in squares)",
    )
    min_correlation: float = Field(
        0.6, gt=0.0, lt=1.0, description="Correlation from which a patch looks alike"
    )
    min_telling: int = Field(8, ge=1, description="Fewer patches tell nothing")
    min_share: float = Field(
        0.6, gt=0.0, lt=1.0, description="Motions that explain fewer patches are not trusted"
    )


class TrustSettings(Settings):
    """Which poses are trusted. Frames with others go into no map."""

    max_sigma_m: float = Field(
        0.05, gt=0.0, description="Largest standard deviation of a motion that is trusted, plus"
    )
    max_sigma_share: float = Field(0.05, ge=0.0, description="this share of its length")
    agreement: AgreementSettings = AgreementSettings()


class PriorSettings(Settings):
    """How a path from elsewhere is used."""

    axes: Literal["camera", "body"] = Field(
        "camera",
        description="Axes of its poses: of the left camera (x right, y down, z forward), or of a "
        "body (x forward, y left, z up) that turns with it and is near to it",
    )
    max_gap_s: float = Field(
        1.0, gt=0.0, description="Between poses farther apart in time nothing is told"
    )
    sigma_m: float = Field(
        0.03, gt=0.0, description="Standard deviation of a motion from frame to frame, plus"
    )
    sigma_share: float = Field(0.03, ge=0.0, description="this share of its length")
    sigma_deg: float = Field(0.5, gt=0.0, description="The same for its rotation")
    max_sigmas: float = Field(
        4.7,
        gt=0.0,
        description="What features say is not believed where it is farther from the path than "
        "this, by the uncertainties of both",
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
        description="Features looked for in the whole picture where tracks are lost",
    )


class PointSettings(Settings):
    """Which pixels go to ICP."""

    min_gradient: float = Field(
        100.0, ge=0.0, description="Least change along the row, 3x3 Sobel of grey values"
    )
    max_disparity_step_px: float = Field(
        0.5, gt=0.0, description="Largest difference of a disparity to its neighbours' median"
    )
    min_range_m: float = Field(1.0, ge=0.0, description="Nearer points are left")
    max_range_m: float = Field(30.0, gt=0.0, description="Farther points are left")
    max_sigma_m: float = Field(1.0, gt=0.0, description="Points with a less certain depth are left")


class KissSettings(Settings):
    """kiss-icp as it comes, on the whole cloud: for comparison."""

    max_range_m: float = Field(30.0, gt=0.0, description="Farther points are left")
    voxel_m: float = Field(0.5, gt=0.0, description="Edge of a voxel of the map")
    initial_threshold_m: float = Field(
        2.0, gt=0.0, description="First value of the adaptive threshold"
    )
    min_motion_m: float = Field(
        0.1, gt=0.0, description="Deviation from the motion model that the threshold ignores"
    )
    min_points: int = Field(1000, ge=10, description="Frames with fewer points are skipped")


class IcpSettings(Settings):
    """ICP of selected points against a local map, from the visual prior."""

    source_range_m: float = Field(
        24.0, gt=0.0, description="Points up to here are aligned; shorter than the map's range"
    )
    voxel_m: float = Field(0.3, gt=0.0, description="Edge of a voxel of the map")
    threshold_m: float = Field(
        0.3, gt=0.0, description="Scale of the robust kernel; points pair up to thrice as far"
    )
    lost_threshold_m: float = Field(
        1.0, gt=0.0, description="The same where there is no visual prior"
    )
    iterations: int = Field(50, ge=1, description="ICP steps at most")
    convergence: float = Field(1e-3, gt=0.0, description="Length of a step that is the last")
    min_points: int = Field(300, ge=10, description="Frames with fewer points are left to vision")
    every: int = Field(
        4,
        ge=1,
        description="ICP is asked and its map updated every so many frames; in between only where "
        "the prior is so unsure that ICP may know better",
    )
    surface_m: float = Field(
        1.0, gt=0.0, description="Edge of the cells in which the map is described by its surfaces"
    )


class GateSettings(Settings):
    """When an ICP correction is taken, and how much of it."""

    min_overlap: float = Field(
        0.5, ge=0.0, le=1.0, description="Share of points that must have a surface of the map near"
    )
    min_residual_gain: float = Field(
        0.02, ge=0.0, lt=1.0, description="Share by which the median residual must fall"
    )
    max_sigmas: float = Field(
        4.7,
        gt=0.0,
        description="Corrections farther from the prior, by both uncertainties, are refused "
        "(4.7: 0.1 % of right ones, six degrees of freedom)",
    )
    min_share: float = Field(
        0.1,
        ge=0.0,
        le=1.0,
        description="In directions where ICP would move the prior by less than this share of its "
        "correction, it knows no better, and the prior stays",
    )
    icp_independence: float = Field(
        0.05, gt=0.0, le=1.0, description="Share of points whose errors count as independent"
    )
    icp_floor_m: float = Field(
        0.02, gt=0.0, description="Standard deviation of ICP that more points do not improve"
    )
    icp_floor_deg: float = Field(0.05, gt=0.0, description="The same for its rotation")
    lost_sigma_m: float = Field(
        0.05,
        gt=0.0,
        description="Standard deviation of a motion extrapolated over one frame; over the n-th "
        "frame without a visual motion it is n times that",
    )
    lost_sigma_deg: float = Field(0.3, gt=0.0, description="The same for its rotation")
    offset_frames: int = Field(
        30,
        ge=1,
        description="Frames over which ICP's standing offset is averaged: what ICP says in every "
        "frame alike is the bias of stereo depth with range, not news",
    )


class FusedSettings(Settings):
    """Visual odometry, and ICP corrections that earn their place."""

    points: PointSettings = PointSettings()
    icp: IcpSettings = IcpSettings()
    gate: GateSettings = GateSettings()


OdometryName = Literal["visual", "kiss", "fused"]


class OdometrySettings(Settings):
    """The odometries: which one, and how each works."""

    method: OdometryName = Field("fused", description="visual, kiss or fused")
    prior: PriorSettings = PriorSettings()
    trust: TrustSettings = TrustSettings()
    visual: VisualSettings = VisualSettings()
    kiss: KissSettings = KissSettings()
    fused: FusedSettings = FusedSettings()
