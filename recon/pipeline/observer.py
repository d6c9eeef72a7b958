"""Who watches a run: the pipeline tells, and knows nothing of bars, files or windows."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Protocol, runtime_checkable

import numpy as np

from recon.odometry.protocol import OdometryHealth
from recon.structures.arrays import Float64, freeze


@dataclass(frozen=True, eq=False)
class FrameResult:
    """What became of one frame.

    Attributes:
        index: Position in the run, from 0.
        total: Number of frames in the run.
        seconds: Time since the last frame was done.
        valid_share: Share of pixels with a disparity, in [0, 1].
        points: Points that the frame gave to the map.
        T_world_camera: float64 (4, 4), its pose.
        health: How far that pose can be trusted.
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
    """Is told of a run's progress, from the thread that runs it."""

    def on_start(self, name: str, total: int) -> None:
        """A run of ``total`` frames begins."""
        ...

    def on_frame(self, result: FrameResult) -> None:
        """One more frame is in the map."""
        ...

    def on_stage(self, name: str) -> None:
        """A stage that is not per frame begins, such as ``mesh``."""
        ...

    def on_finish(self) -> None:
        """The run has ended, well or not."""
        ...
