"""What every odometry takes, gives and promises."""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import Any, Protocol, runtime_checkable

import numpy as np

from recon.core.values import Disparity, Rectified
from recon.core.values.arrays import Float64, array_in


@dataclass(frozen=True, eq=False)
class OdometryFrame:
    """What an odometry is given of one frame."""

    pair: Rectified  # the rectified images
    disparity: Disparity  # what was measured of their disparity; what was inferred is left out
    rough: bool = False  # whether it is matched in a hurry, and a third of the features do

    def __post_init__(self) -> None:
        object.__setattr__(self, "disparity", self.disparity.only_measured())


@dataclass(frozen=True)
class OdometryHealth:
    """How far the pose of one frame can be trusted. NaN = does not apply or not measured."""

    # False where the pose is not to be trusted: it is extrapolated, or the image contradicts it
    ok: bool = True
    # True where later poses are measured past this one, from those before it. After any other pose
    # that is not ok, nothing says where the later ones are.
    skipped: bool = False
    # True where nothing says where this frame lies beside those before; later ones are measured
    # from it
    begins: bool = False
    known: bool = False  # True where the pose was given, not measured: nothing later changes it
    tracks: int = 0  # features followed from the last frame
    inliers: int = 0  # features that agree with the visual motion
    reprojection_px: float = float("nan")  # their median reprojection error
    # Standard deviation of the visual translation, given the frames before: from how well features
    # fit, and how far their disparities may be off
    sigma_m: float = float("nan")
    sigma_deg: float = float("nan")  # that of the rotation
    # Disparity on which the length of the motion rests: the mean over the features, each weighted
    # by its information. If all disparities are off by 1 % of it, so is the length of the motion.
    scale_px: float = float("nan")
    icp_points: int = 0  # points given to ICP
    visual_m: tuple[float, ...] = ()  # where visual odometry alone would be (x, y, z), if not there
    # Why something was refused or went wrong, for the log
    notes: tuple[str, ...] = field(default=())
    # Problems of the frame that the user should know, even if it has a pose
    warnings: tuple[str, ...] = field(default=())


@dataclass(frozen=True, eq=False)
class OdometryResult:
    """Where the left camera was when the frame was taken."""

    T_world_camera: Float64  # (4, 4); the first frame is the identity
    health: OdometryHealth = OdometryHealth()  # how far it can be trusted


@runtime_checkable
class Odometry(Protocol):
    """Tracks the camera from frame to frame; holds state, so frames must come in order.

    A drive that is resumed from its state gives the same poses as without a break.
    """

    def register(self, frame: OdometryFrame) -> OdometryResult:
        """Register the next frame. On a poor or empty one the health says so; poses never jump."""
        ...

    def state(self) -> dict[str, Any]:
        """Return everything that later poses depend on, as a tree of arrays and plain values."""
        ...

    def restore(self, state: dict[str, Any]) -> None:
        """Continue from a `state` of an odometry with the same settings."""
        ...


def pose_in(state: dict[str, Any], name: str) -> Float64:
    """Return a pose of a state: float64 (4, 4), finite."""
    return array_in(state, name, np.float64, (4, 4))
