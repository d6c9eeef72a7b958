"""What an inertial unit measured."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from recon.core.values.arrays import Float64, freeze


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
