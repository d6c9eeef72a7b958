"""Settings of loop closure, summed in `LoopSettings`."""

from __future__ import annotations

from pydantic import Field

from recon.core.settings import Settings


class KeyframeSettings(Settings):
    """Which frames are kept for recognition, and what of them."""

    distance_m: float = Field(
        1.5,
        gt=0.0,
        le=100.0,
        description="Distance from the last keyframe at which a new one is taken.",
    )
    angle_deg: float = Field(
        10.0,
        gt=0.0,
        le=180.0,
        description="Rotation since the last keyframe at which a new one is taken.",
    )
    features: int = Field(500, ge=50, le=10000, description="ORB features of a keyframe.")
    cell_px: int = Field(
        48, ge=8, le=1024, description="Edge of the cells that features are spread over."
    )
    fast_threshold: int = Field(
        10, ge=1, le=255, description="Threshold of the FAST corner detector."
    )
    min_disparity_px: float = Field(
        1.0, gt=0.0, description="Features with less disparity have no usable depth."
    )
    max_disparity_step_px: float = Field(
        1.0, gt=0.0, description="Largest difference between a disparity and its neighbours."
    )
    coarse_px: int = Field(
        8, ge=1, le=64, description="Every n-th disparity of a row and column is kept."
    )


class DriftSettings(Settings):
    """How far odometry may drift; larger values give more candidates and refuse less."""

    share: float = Field(
        0.02,
        gt=0.0,
        le=1.0,
        description="Standard deviation of a position, as a share of the path.",
    )
    turn_deg: float = Field(
        0.15,
        gt=0.0,
        le=10.0,
        description="Standard deviation of the heading after 1 m; grows with the root of the path.",
    )
    lost_factor: float = Field(
        20.0, ge=1.0, description="Metres that one metre of extrapolated path counts as."
    )
    lost_m: float = Field(
        2.0, ge=0.0, description="Path that is added for each frame without a measurement."
    )
    sigmas: float = Field(
        3.5,
        gt=0.0,
        le=10.0,
        description="Largest possible deviation from odometry, in standard deviations.",
    )


class CandidateSettings(Settings):
    """Which old keyframes are compared with a new one."""

    min_path_m: float = Field(25.0, gt=0.0, description="Least path between the two.")
    view_m: float = Field(
        8.0, gt=0.0, description="Largest distance at which two places see enough in common."
    )
    view_deg: float = Field(
        45.0, gt=0.0, le=180.0, description="Largest such angle between their viewing directions."
    )
    tables: int = Field(4, ge=1, le=16, description="Words per descriptor (hash tables).")
    bits: int = Field(20, ge=8, le=24, description="Bits of a descriptor per word.")
    min_likeness: float = Field(
        0.3,
        ge=0.0,
        le=1.0,
        description="Least likeness, as a share of that of two neighbouring keyframes.",
    )
    verified: int = Field(3, ge=1, le=100, description="Most candidates that are verified.")
    apart_m: float = Field(4.0, ge=0.0, description="Least path between two candidates.")


class VerifySettings(Settings):
    """When geometry confirms a candidate."""

    max_hamming: int = Field(64, ge=1, le=256, description="Largest Hamming distance of a match.")
    reprojection_px: float = Field(2.5, gt=0.0, le=20.0, description="RANSAC's inlier limit.")
    iterations: int = Field(500, ge=10, le=100000, description="RANSAC's samples at most.")
    min_inliers: int = Field(
        20, ge=6, description="Least number of matches that agree in both directions."
    )
    min_inlier_share: float = Field(
        0.3, gt=0.0, le=1.0, description="Least share of the matches that agree."
    )
    spread_cells: int = Field(
        5, ge=1, le=16, description="Of 4 by 4 cells of each image, how many must hold inliers."
    )
    both_ways_m: float = Field(
        0.5, gt=0.0, description="Largest distance between the poses found in either direction."
    )
    both_ways_deg: float = Field(2.0, gt=0.0, description="Largest angle between them.")
    sigma_uv_px: float = Field(
        1.0, gt=0.0, description="Standard deviation of a feature's column or row."
    )
    sigma_d_px: float = Field(1.0, gt=0.0, description="Standard deviation of its disparity.")
    max_sigma_m: float = Field(
        0.3, gt=0.0, description="Loops less certain than this in any direction are refused."
    )
    dense_tolerance_px: float = Field(
        1.0,
        gt=0.0,
        description="Largest difference between a predicted and a seen disparity that agree.",
    )
    dense_tolerance_share: float = Field(
        0.03,
        ge=0.0,
        le=1.0,
        description="Share of the disparity that is added to `dense_tolerance_px`.",
    )
    min_dense_share: float = Field(
        0.75, ge=0.0, le=1.0, description="Least share of the dense points that agree."
    )
    min_dense_points: int = Field(
        50, ge=1, description="Least number of dense points that both frames see."
    )


class GraphSettings(Settings):
    """The pose graph that closes the loops."""

    node_m: float = Field(5.0, gt=0.0, description="Path between two nodes of the graph.")
    max_nodes: int = Field(
        400, ge=2, le=5000, description="Longer drives get nodes farther apart: time is cubic."
    )
    loop_sigma_m: float = Field(
        0.05, gt=0.0, description="Standard deviation of a loop that more matches do not improve."
    )
    loop_share: float = Field(
        0.03,
        ge=0.0,
        le=1.0,
        description="Standard deviation that is added per distance between its two frames: "
        "features that moved farther match worse, and not evenly.",
    )
    loop_sigma_deg: float = Field(0.1, gt=0.0, description="As `loop_sigma_m`, of its rotation.")
    max_chi2: float = Field(
        22.5,
        gt=0.0,
        description="Chi-square at which the weight of a loop is a quarter (22.5: 0.1 % of right "
        "ones are beyond).",
    )
    max_bend_chi2: float = Field(
        6.0,
        gt=0.0,
        description="Mean chi-square of the odometry edges above which no loop is believed.",
    )


class LoopSettings(Settings):
    """Loop closure: recognising a place, verifying it and correcting the path."""

    enabled: bool = Field(True, description="Look for loops and close them.")
    keyframes: KeyframeSettings = KeyframeSettings()
    drift: DriftSettings = DriftSettings()
    candidates: CandidateSettings = CandidateSettings()
    verify: VerifySettings = VerifySettings()
    min_agreeing: int = Field(
        3, ge=1, le=20, description="Loops of different keyframes that must agree."
    )
    agree_m: float = Field(
        12.0, gt=0.0, description="Path within which neighbouring loops are compared."
    )
    graph: GraphSettings = GraphSettings()
