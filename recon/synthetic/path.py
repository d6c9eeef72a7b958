"""Where the street runs and where the cameras are on it.

Street axes: x along the street at its start, y left, z up, the road at z = 0.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from recon.geometry import se3
from recon.structures.arrays import Float64
from recon.synthetic.settings import StreetSettings

LANE_M = -1.55  # the car keeps to the right of the centre line
_STEP_M = 0.25
_BEFORE_M = 60.0
# Columns are the camera's axes (right, down, forward) in street axes.
R_STREET_LEVEL = np.array([[0.0, 0.0, 1.0], [-1.0, 0.0, 0.0], [0.0, -1.0, 0.0]])


@dataclass(frozen=True, eq=False)
class CentreLine:
    """The middle of the road, by the distance along it.

    Attributes:
        along_m: float64 (N,), distances, increasing; 0 is where the drive begins.
        xy_m: float64 (N, 2), street axes.
        heading_rad: float64 (N,), direction, counter-clockwise from x.
    """

    along_m: Float64
    xy_m: Float64
    heading_rad: Float64

    def heading(self, along_m: float) -> float:
        """Direction of the road at a distance."""
        return float(np.interp(along_m, self.along_m, self.heading_rad))

    def points(self, along_m: NDArray[np.float64], lateral_m: NDArray[np.float64]) -> Float64:
        """Points (N, 2) at distances and to the left (positive) of the centre line."""
        x = np.interp(along_m, self.along_m, self.xy_m[:, 0])
        y = np.interp(along_m, self.along_m, self.xy_m[:, 1])
        heading = np.interp(along_m, self.along_m, self.heading_rad)
        return np.stack([x - lateral_m * np.sin(heading), y + lateral_m * np.cos(heading)], axis=-1)

    def place(self, along_m: float, lateral_m: float, height_m: float = 0.0) -> Float64:
        """``T_street_object`` of an object that faces along the road there."""
        x, y = self.points(np.array([along_m]), np.array([lateral_m]))[0]
        return se3.make_transform(
            se3.exp_so3(np.array([0.0, 0.0, self.heading(along_m)])), np.array([x, y, height_m])
        )


def centre_line(settings: StreetSettings, length_m: float) -> CentreLine:
    """The road from 60 m before the start to ``length_m`` beyond it."""
    along = np.arange(-_BEFORE_M, length_m + _STEP_M, _STEP_M)
    heading = _heading(along, settings)
    middle = 0.5 * (heading[:-1] + heading[1:])
    steps = _STEP_M * np.stack([np.cos(middle), np.sin(middle)], axis=1)
    xy = np.vstack([np.zeros((1, 2)), np.cumsum(steps, axis=0)])
    return CentreLine(along, xy - xy[np.searchsorted(along, 0.0)], heading)


def _heading(along_m: Float64, settings: StreetSettings) -> Float64:
    if settings.path == "straight":
        return np.zeros_like(along_m)
    rate = math.radians(settings.turn_deg_per_100m) / 100.0
    # A road is no perfect arc: it winds a little about it.
    winding = 0.35 * rate * 18.0 * np.sin(along_m / 18.0)
    return np.asarray(rate * along_m + winding)


def camera_poses(settings: StreetSettings, road: CentreLine) -> Float64:
    """``T_street_camera`` (frames, 4, 4) of the left camera, street axes."""
    along = settings.speed_m_per_frame * np.arange(settings.frames)
    return np.stack([_camera_pose(float(s), settings, road) for s in along])


def _camera_pose(along_m: float, settings: StreetSettings, road: CentreLine) -> Float64:
    """The car's place on the road, its small motions, and how the rig is mounted on it."""
    phase = 0.7 * (settings.seed % 997)
    drift = 0.2 * settings.sway * math.sin(along_m / 11.0 + phase)
    slope = 0.2 * settings.sway / 11.0 * math.cos(along_m / 11.0 + phase)
    nod = math.radians(0.25) * settings.sway * math.sin(along_m / 3.1 + phase)
    lean = math.radians(0.15) * settings.sway * math.sin(along_m / 4.3 + 2.0 * phase)
    heave = 0.015 * settings.sway * math.sin(along_m / 2.7 + 3.0 * phase)
    T = road.place(along_m, LANE_M + drift, settings.camera_height_m + heave)
    T[:3, :3] = T[:3, :3] @ se3.exp_so3(np.array([0.0, 0.0, math.atan(slope)])) @ R_STREET_LEVEL
    yaw, pitch, roll = np.radians([settings.yaw_deg, settings.pitch_deg, settings.roll_deg])
    for turn in ((0.0, yaw, 0.0), (-pitch - nod, 0.0, 0.0), (0.0, 0.0, roll + lean)):
        T[:3, :3] = T[:3, :3] @ se3.exp_so3(np.array(turn))
    return T
