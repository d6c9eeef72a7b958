"""How measured positions fit a path, and how much of that drift and noise explain."""

from __future__ import annotations

import math
from dataclasses import dataclass
from os import PathLike
from typing import Final

import numpy as np

from recon.core.errors import EvaluationError
from recon.core.geometry.alignment import fit_points
from recon.core.geometry.se3 import apply
from recon.core.values import Trajectory
from recon.core.values.arrays import Bool, Float64
from recon.places.drift import SIGMAS, drift_over, path_lengths

RECEIVER_M: Final = 10.0
"""Standard deviation of a measured coordinate where no file states it: a receiver among houses."""

_OTHER_UNIT: Final = 3.0
"""A foot, the unit of surveys that is nearest to a metre, is 3.28 times shorter."""

_TINY: Final = 1e-12
_SHORTEST_M: Final = 0.1
"""Path below which nothing is a share of it."""


@dataclass(frozen=True)
class PathFit:
    """How positions fit a path.

    Attributes:
        rms_m: How far they are apart after a rigid fit, root mean square.
        scaled_m: The same after a fit that also scales the path.
        scale: How many times as far from one another as those of the path the positions are.
        most_m: Largest distance that drift and noise explain.
        most_stretch: Largest difference of the scale from 1 that they explain.
    """

    rms_m: float
    scaled_m: float
    scale: float
    most_m: float
    most_stretch: float

    @property
    def stretched(self) -> bool:
        """Whether the scale is one that nothing explains."""
        return abs(self.scale - 1.0) > self.most_stretch

    @property
    def other_unit(self) -> bool:
        """Whether it is the same path, but in another unit; a scale that is off is none."""
        apart = abs(math.log(max(self.scale, _TINY)))
        return self.stretched and self.scaled_m <= self.most_m and apart > math.log(_OTHER_UNIT)

    def check(self, where: str | PathLike[str], hint: str) -> None:
        """Refuse positions that neither drift nor noise explains."""
        if self.rms_m <= self.most_m and not self.stretched:
            return
        least, most = max(0.0, 1.0 - self.most_stretch), 1.0 + self.most_stretch
        raise EvaluationError(
            "neither drift nor noise explains how far positions and path are apart",
            where=where,
            got=f"{self.rms_m:.3g} m (RMS), {self.scale:.3g} times as far from one another",
            expected=f"at most {self.most_m:.3g} m, {least:.2f} to {most:.2f} times",
            hint=hint,
        )


def fit_to_path(
    ours_m: Float64, position_m: Float64, drift_m: float, sigma_m: float = RECEIVER_M
) -> PathFit:
    """Return how positions fit those of a path.

    Args:
        ours_m: float64 (N, 3), by the path, in the order of time.
        position_m: float64 (N, 3), as they were measured, in other axes.
        drift_m: By how much the path may be off at its end, standard deviation.
        sigma_m: Standard deviation of a measured coordinate.
    """
    rigid, scaled = (fit_points(ours_m, position_m, scaled=scaled) for scaled in (False, True))
    path_m = float(np.linalg.norm(np.diff(ours_m, axis=0), axis=1).sum())
    spread_m = _apart_m(ours_m, ours_m.mean(axis=0))
    return PathFit(
        rms_m=_apart_m(apply(rigid.T_to_from, ours_m), position_m),
        scaled_m=_apart_m(apply(scaled.T_to_from, scaled.scale * ours_m), position_m),
        scale=scaled.scale,
        most_m=SIGMAS * math.hypot(drift_m, sigma_m),
        most_stretch=SIGMAS
        * math.hypot(drift_m / max(path_m, _SHORTEST_M), sigma_m / max(spread_m, _SHORTEST_M)),
    )


def drift_at_end(
    path: Trajectory, trusted: Bool | None = None, stated_percent: float | None = None
) -> float:
    """Return by how much a path may be off at its end, standard deviation in metres.

    Args:
        path: The path.
        trusted: bool (N,), False where a pose is not; None = all are.
        stated_percent: What its odometry states of its drift, per cent of the path; None = nothing.
    """
    good = np.ones(len(path), np.bool_) if trusted is None else trusted
    length_m = float(path_lengths(path.T_world_camera, good)[-1])
    return max(drift_over(length_m).position_m, (stated_percent or 0.0) / 100.0 * length_m)


def _apart_m(ones: Float64, others: Float64) -> float:
    """Return how far points (N, 3) are from others, root mean square."""
    return float(np.sqrt(np.mean(np.sum((ones - others) ** 2, axis=-1))))
