"""What every odometry takes, gives and promises."""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import Protocol, runtime_checkable

import numpy as np

from recon.structures import Disparity, RectifiedPair
from recon.structures.arrays import Float64, freeze


@dataclass(frozen=True, eq=False)
class OdometryFrame:
    """What an odometry is given of one frame.

    Attributes:
        pair: The rectified pictures.
        disparity: Their disparity.
    """

    pair: RectifiedPair
    disparity: Disparity


@dataclass(frozen=True)
class OdometryHealth:
    """How far the pose of one frame can be trusted. NaN = does not apply or not measured.

    Attributes:
        ok: False where the pose is not to be trusted: it is extrapolated, or the picture
            contradicts it.
        tracks: Features followed from the last frame.
        inliers: Features that agree with the visual motion.
        reprojection_px: Their median reprojection error.
        sigma_m: Standard deviation of the visual translation, given the frames before.
        sigma_deg: That of the rotation.
        icp_points: Points given to ICP.
        overlap: Share of ICP source points with a neighbour in the map.
        residual_m: Median distance of those to the map.
        correction_m: Translation by which ICP would move the prior.
        correction_deg: Rotation by which ICP would move the prior.
        accepted: True where (a part of) the ICP correction was applied.
        notes: Why something was refused or went wrong, for the log.
        warnings: Problems of the frame that the user should know, even if it has a pose.
    """

    ok: bool = True
    tracks: int = 0
    inliers: int = 0
    reprojection_px: float = float("nan")
    sigma_m: float = float("nan")
    sigma_deg: float = float("nan")
    icp_points: int = 0
    overlap: float = float("nan")
    residual_m: float = float("nan")
    correction_m: float = float("nan")
    correction_deg: float = float("nan")
    accepted: bool = False
    notes: tuple[str, ...] = field(default=())
    warnings: tuple[str, ...] = field(default=())


@dataclass(frozen=True, eq=False)
class OdometryResult:
    """Where the left camera was when the frame was taken.

    Attributes:
        T_world_camera: float64 (4, 4); the first frame is the identity.
        health: How far it can be trusted.
    """

    T_world_camera: Float64
    health: OdometryHealth

    def __post_init__(self) -> None:
        freeze(self, "T_world_camera", np.float64, (4, 4))


@runtime_checkable
class Odometry(Protocol):
    """Tracks the camera from frame to frame; holds state, so frames must come in order.

    It can be pickled: a drive resumed from the copy gives the same poses as without a break.
    """

    def register(self, frame: OdometryFrame) -> OdometryResult:
        """Register the next frame. On a poor or empty one the health says so; poses never jump."""
        ...
