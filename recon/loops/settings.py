"""Settings of loop closure, summed in `LoopSettings`."""

from __future__ import annotations

from pydantic import Field

from recon.settings import Settings


class KeyframeSettings(Settings):
    """Which frames are kept for recognition, and what of them."""

    distance_m: float = Field(1.5, gt=0.0, le=100.0, description="Path between two keyframes")
    angle_deg: float = Field(10.0, gt=0.0, le=180.0, description="Or the turn between them")
    features: int = Field(500, ge=50, le=10000, description="ORB features of a keyframe")
    cell_px: int = Field(48, ge=8, le=1024, description="Features are spread over such cells")
    fast_threshold: int = Field(10, ge=1, le=255, description="Least contrast of a corner")
    min_disparity_px: float = Field(
        1.0, gt=0.0, description="Features with less disparity have no usable depth"
    )
    max_disparity_step_px: float = Field(
        1.0, gt=0.0, description="Largest difference of a disparity to its neighbours"
    )
    coarse_px: int = Field(
        8, ge=1, le=64, description="One disparity of so many rows and columns is kept"
    )


class DriftSettings(Settings):
    """How wrong odometry may be; the more, the more candidates, and the less is refused."""

    share: float = Field(
        0.02, gt=0.0, le=1.0, description="Standard deviation of a position, per path"
    )
    turn_deg: float = Field(
        0.15,
        gt=0.0,
        le=10.0,
        description="Standard deviation of the heading after 1 m; grows with the path's root",
    )
    lost_factor: float = Field(
        20.0, ge=1.0, description="A metre of extrapolated path counts as so many"
    )
    lost_m: float = Field(
        2.0, ge=0.0, description="Path that a frame without a measurement counts as besides"
    )
    sigmas: float = Field(
        3.5, gt=0.0, le=10.0, description="Deviation from odometry that is still possible"
    )


class CandidateSettings(Settings):
    """Which old keyframes are compared with a new one."""

    min_path_m: float = Field(25.0, gt=0.0, description="Path between the two, at least")
    view_m: float = Field(
        8.0, gt=0.0, description="Places so far apart still see enough of the same"
    )
    view_deg: float = Field(45.0, gt=0.0, le=180.0, description="The same for directions")
    tables: int = Field(4, ge=1, le=16, description="Words that each descriptor gives")
    bits: int = Field(20, ge=8, le=24, description="Bits of a descriptor that make a word")
    min_likeness: float = Field(
        0.3,
        ge=0.0,
        le=1.0,
        description="Least likeness, as a share of that of two neighbouring keyframes",
    )
    verified: int = Field(3, ge=1, le=100, description="Candidates that are verified at most")
    apart_m: float = Field(4.0, ge=0.0, description="Path between two candidates, at least")


class VerifySettings(Settings):
    """When geometry confirms a candidate."""

    max_hamming: int = Field(64, ge=1, le=256, description="Largest distance of a match")
    reprojection_px: float = Field(2.5, gt=0.0, le=20.0, description="RANSAC's inlier limit")
    iterations: int = Field(500, ge=10, le=100000, description="RANSAC's samples at most")
    min_inliers: int = Field(20, ge=6, description="Matches that must agree, seen both ways")
    min_inlier_share: float = Field(
        0.3, gt=0.0, le=1.0, description="Share of the matches that must agree"
    )
    spread_cells: int = Field(
        5, ge=1, le=16, description="Of 4 by 4 cells of each picture, how many must hold some"
    )
    both_ways_m: float = Field(
        0.5, gt=0.0, description="Largest difference of the poses found there and back"
    )
    both_ways_deg: float = Field(2.0, gt=0.0, description="The same for their rotations")
    sigma_uv_px: float = Field(1.0, gt=0.0, description="Standard deviation of a feature's place")
    sigma_d_px: float = Field(1.0, gt=0.0, description="Standard deviation of its disparity")
    max_sigma_m: float = Field(
        0.3, gt=0.0, description="A loop less certain than this in any direction is left"
    )
    dense_tolerance_px: float = Field(
        1.0, gt=0.0, description="Difference of predicted and seen disparity that agrees"
    )
    dense_tolerance_share: float = Field(
        0.03, ge=0.0, le=1.0, description="The same as a share of the disparity, added to it"
    )
    min_dense_share: float = Field(
        0.75, ge=0.0, le=1.0, description="Share of the dense points that must agree"
    )
    min_dense_points: int = Field(
        50, ge=1, description="Dense points that both must see for that share to count"
    )


class GraphSettings(Settings):
    """How the path is bent so that loops close."""

    node_m: float = Field(5.0, gt=0.0, description="Path between two nodes of the graph")
    max_nodes: int = Field(
        400, ge=2, le=5000, description="Longer drives get nodes farther apart: time is cubic"
    )
    loop_sigma_m: float = Field(
        0.05, gt=0.0, description="Standard deviation of a loop that more matches do not improve"
    )
    loop_share: float = Field(
        0.03,
        ge=0.0,
        le=1.0,
        description="The same per distance between its two frames: features that moved farther "
        "match worse, and not evenly",
    )
    loop_sigma_deg: float = Field(0.1, gt=0.0, description="The same for its rotation")
    max_chi2: float = Field(
        22.5,
        gt=0.0,
        description="Misfit at which a loop counts a quarter (22.5: 0.1 % of right ones)",
    )
    max_bend_chi2: float = Field(
        6.0,
        gt=0.0,
        description="Mean misfit of the odometry, per step between nodes, above which no loop "
        "is believed",
    )


class LoopSettings(Settings):
    """Loop closure: where a drive comes back to a place, and what follows from that."""

    enabled: bool = Field(True, description="Look for loops and close them")
    keyframes: KeyframeSettings = KeyframeSettings()
    drift: DriftSettings = DriftSettings()
    candidates: CandidateSettings = CandidateSettings()
    verify: VerifySettings = VerifySettings()
    min_agreeing: int = Field(
        3, ge=1, le=20, description="Loops of different keyframes that must tell the same"
    )
    agree_m: float = Field(
        12.0, gt=0.0, description="Path within which neighbouring loops are compared"
    )
    graph: GraphSettings = GraphSettings()
