"""Observers of a run, which keep the pipeline independent of progress bars and viewers."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Protocol, runtime_checkable

import numpy as np

from recon.core.values.arrays import Float64, freeze
from recon.odometry.protocol import OdometryHealth


@dataclass(frozen=True, eq=False)
class FrameResult:
    """Result of one frame.

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


@runtime_checkable
class Observer(Protocol):
    """Receives the progress of a run, in the thread that runs it."""

    def on_start(self, name: str, total: int) -> None:
        """A run of ``total`` frames begins."""
        ...

    def on_frame(self, result: FrameResult) -> None:
        """A frame is registered."""
        ...

    def on_stage(self, name: str) -> None:
        """A stage that is not per frame, such as ``mesh``, begins."""
        ...

    def on_finish(self) -> None:
        """The run has ended, successfully or not."""
        ...
