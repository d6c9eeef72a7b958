"""Association of the poses of two trajectories by timestamp."""

from __future__ import annotations

from typing import Final

import numpy as np

from recon.core.errors import EvaluationError
from recon.core.geometry.interpolation import nearest_sorted
from recon.core.values import Trajectory

TOLERANCE_S: Final = 0.01
"""Largest time difference of two associated poses, unless another is given."""


def associate(
    estimate: Trajectory, truth: Trajectory, tolerance_s: float
) -> tuple[Trajectory, Trajectory]:
    """Match poses that are mutually nearest in time; poses without a match are left out.

    Args:
        estimate: Estimated trajectory.
        truth: True trajectory, on the same clock; its rate may differ.
        tolerance_s: Largest time difference of a match.

    Returns:
        Two trajectories of equal length, pose by pose, each with its own timestamps.
    """
    there = nearest_sorted(estimate.timestamps_s, truth.timestamps_s)
    back = nearest_sorted(truth.timestamps_s, estimate.timestamps_s)
    apart_s = np.abs(truth.timestamps_s[there] - estimate.timestamps_s)
    mutual = (back[there] == np.arange(len(estimate))) & (apart_s <= tolerance_s)
    if not mutual.any():
        raise EvaluationError(
            "no poses of the two trajectories match in time",
            got=f"times {_span(estimate)} and {_span(truth)}",
            expected=f"times within {tolerance_s:g} s of each other",
            hint="raise --tolerance, or make sure that both use the same clock",
        )
    return estimate.select(mutual), truth.select(there[mutual])


def _span(path: Trajectory) -> str:
    return f"{path.timestamps_s[0]:.3f} to {path.timestamps_s[-1]:.3f} s"
