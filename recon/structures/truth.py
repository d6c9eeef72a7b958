"""Ground truth, where a source has it."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from recon.structures.arrays import Bool, Float32, freeze
from recon.structures.cloud import PointCloud
from recon.structures.trajectory import Trajectory


@dataclass(frozen=True, eq=False)
class DisparityTruth:
    """True disparity of the left view.

    Attributes:
        values: float32 (H, W), pixels; NaN = unknown.
        nonocc: bool (H, W), True where the point is seen by both cameras.
    """

    values: Float32
    nonocc: Bool

    def __post_init__(self) -> None:
        freeze(self, "values", np.float32, (None, None))
        freeze(self, "nonocc", np.bool_, self.values.shape)


@dataclass(frozen=True, eq=False)
class SequenceTruth:
    """Truth of a drive; each part may be unknown (None).

    Attributes:
        trajectory: True poses, one per frame; the first is the identity.
        surface: Points on the true surfaces, frame ``world``.
    """

    trajectory: Trajectory | None = None
    surface: PointCloud | None = None
