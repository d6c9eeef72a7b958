"""What is known of a frame once it is in the map: a step of the run's progress."""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Any

import numpy as np

from recon.core.values.arrays import Float64, freeze
from recon.core.words import counted
from recon.odometry.protocol import OdometryHealth


@dataclass(frozen=True, eq=False)
class FrameResult:
    """Result of one frame; a `Step` of the progress of a run.

    Attributes:
        index: Position in the run, from 0.
        total: Number of frames in the run.
        seconds: Time since the previous frame was done.
        valid_share: Share of pixels with a disparity, in [0, 1].
        points: Number of points in the cloud of the frame.
        T_world_camera: float64 (4, 4), its pose.
        health: Health of that pose.
    """

    index: int
    total: int
    seconds: float
    valid_share: float
    points: int
    T_world_camera: Float64
    health: OdometryHealth

    def __post_init__(self) -> None:
        freeze(self, "T_world_camera", np.float64, (4, 4))

    @property
    def ok(self) -> bool:
        """Whether the pose is trusted."""
        return self.health.ok

    @property
    def event(self) -> dict[str, Any]:
        """The frame for programs; what is NaN is None."""
        return {
            "event": "frame",
            "index": self.index,
            "total": self.total,
            "seconds": round(self.seconds, 4),
            "valid_share": _finite(self.valid_share),
            "points": self.points,
            "position_m": [_finite(x) for x in self.T_world_camera[:3, 3].tolist()],
            "measured": self.health.ok,
            "inliers": self.health.inliers,
            "notes": list(self.health.notes),
        }

    @property
    def state(self) -> str:
        """The frame for people: share of valid pixels, and whether the pose is trusted."""
        pose = counted(self.health.inliers, "inlier") if self.ok else "pose not trusted"
        return f"{100 * self.valid_share:.0f} % valid, {pose}"


def _finite(value: float) -> float | None:
    return round(value, 6) if math.isfinite(value) else None
