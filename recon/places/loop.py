"""A loop: a place that two frames show, of one drive or of two."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from recon.core.values.arrays import Float64, freeze


@dataclass(frozen=True, eq=False)
class Loop:
    """Two frames that show the same place, and the motion between them.

    Attributes:
        first: Number of the earlier frame.
        last: Number of the later frame.
        T_first_last: float64 (4, 4).
        information: float64 (6, 6) of a step (translation in metres, rotation vector in radians)
            in the axes of the later frame.
        inliers: Matches that agree in both frames.
        dense_share: Share of the coarse disparities that agree.
        same_frame: Whether the two are one frame, in two recordings that overlap.
    """

    first: int
    last: int
    T_first_last: Float64
    information: Float64
    inliers: int
    dense_share: float
    same_frame: bool = False

    def __post_init__(self) -> None:
        freeze(self, "T_first_last", np.float64, (4, 4))
        freeze(self, "information", np.float64, (6, 6))
