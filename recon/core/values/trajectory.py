"""Trajectories of the left camera, and what an inertial unit measured on them."""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import Any

import numpy as np
from numpy.typing import NDArray
from typing_extensions import Self

from recon.core.errors import ShapeError
from recon.core.lazy import Shown
from recon.core.text import counted
from recon.core.values.arrays import Float64, freeze


@dataclass(frozen=True, eq=False)
class Trajectory(Shown):
    """Poses of the left camera, float64 (N, 4, 4), metres, and not decreasing times, float64 (N,).

    ``xyz_world = apply(T_world_camera, xyz_camera)``.
    """

    T_world_camera: Float64
    timestamps_s: Float64

    def __post_init__(self) -> None:
        freeze(self, "T_world_camera", np.float64, (None, 4, 4))
        freeze(self, "timestamps_s", np.float64, (len(self.T_world_camera),))
        broken = ~np.isfinite(self.T_world_camera).all(axis=(1, 2))
        if broken.any():
            raise ShapeError(f"pose {int(np.argmax(broken))} is not finite")

    def __repr__(self) -> str:
        seconds = self.timestamps_s[-1] - self.timestamps_s[0] if len(self) else 0.0
        poses = counted(len(self), "pose")
        return f"Trajectory({poses}, {self.path_length_m:.4g} m, {seconds:.4g} s)"

    def select(self, frames: NDArray[Any]) -> Self:
        """Return the poses of some frames, by numbers or bool (N,)."""
        return replace(
            self, T_world_camera=self.T_world_camera[frames], timestamps_s=self.timestamps_s[frames]
        )

    def __len__(self) -> int:
        return len(self.T_world_camera)

    @property
    def positions_m(self) -> Float64:
        """float64 (N, 3), the camera centres."""
        return self.T_world_camera[:, :3, 3]

    @property
    def distances_m(self) -> Float64:
        """float64 (N,), path length from the first pose to each pose."""
        steps = np.linalg.norm(np.diff(self.positions_m, axis=0), axis=1)
        return np.concatenate([np.zeros(min(1, len(self))), np.cumsum(steps)])

    @property
    def path_length_m(self) -> float:
        return float(self.distances_m[-1]) if len(self) else 0.0


@dataclass(frozen=True, eq=False)
class ImuRecord:
    """Rates of turn and specific forces of an inertial unit, in its own axes.

    Attributes:
        timestamps_s: float64 (N,), increasing, on the clock of the images.
        gyro: float64 (N, 3), radians per second.
        accel: float64 (N, 3), metres per second squared; +9.8 upwards at rest.
        T_camera_imu: float64 (4, 4), from its axes to those of the left camera as it is recorded;
            None = not known.
        origin: Where it is from, for the user.
        notes: What was wrong with it, a line each.
    """

    timestamps_s: Float64
    gyro: Float64
    accel: Float64
    T_camera_imu: Float64 | None = None
    origin: str = ""
    notes: tuple[str, ...] = ()

    def __post_init__(self) -> None:
        freeze(self, "timestamps_s", np.float64, (None,))
        for name in ("gyro", "accel"):
            freeze(self, name, np.float64, (len(self.timestamps_s), 3))

    def __len__(self) -> int:
        return len(self.timestamps_s)
