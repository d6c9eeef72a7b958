"""The course of the street, and the camera poses along it.

Street axes: x along the street at its start, y left, z up, the road at z = 0.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from itertools import pairwise
from typing import Any, Final

import numpy as np
from numpy.typing import NDArray

from recon.core.geometry import se3
from recon.core.values.arrays import Float64
from recon.street.settings import CORNER_M, StreetScene
from recon.street.shapes import at

LANE_M = -1.55  # the car keeps to the right of the centre line
_STEP_M = 0.25
_BEFORE_M = 60.0
_BARE_M: Final = 60.0  # without objects, at the end of an open road behind the last row of trees
BEHIND_M: Final = 30.0  # objects begin this far behind the start
# Columns are the camera's axes (right, down, forward) in street axes.
R_STREET_LEVEL = np.array([[0.0, 0.0, 1.0], [-1.0, 0.0, 0.0], [0.0, -1.0, 0.0]])


@dataclass(frozen=True, eq=False)
class CentreLine:
    """The centre line of the road, parametrised by the distance along it."""

    along_m: Float64  # (N,), distances, increasing; the drive begins at 0
    xy_m: Float64  # (N, 2), street axes
    heading_rad: Float64  # (N,), direction, counter-clockwise from x
    #: Range of distances with objects; a repeated street is laid out over one period.
    span_m: tuple[float, float]
    loop_m: float | None = None  # length of one lap if the line is closed

    def heading(self, along_m: float) -> float:
        """Return the direction of the road at a distance along it."""
        return float(np.interp(self._in_lap(along_m), self.along_m, self.heading_rad))

    def points(self, along_m: NDArray[np.float64], lateral_m: NDArray[np.float64]) -> Float64:
        """Return points (N, 2) at distances along the centre line and offsets to its left."""
        s = self._in_lap(along_m)
        curves = (*self.xy_m.T, self.heading_rad)
        x, y, heading = (np.interp(s, self.along_m, values) for values in curves)
        return np.stack([x - lateral_m * np.sin(heading), y + lateral_m * np.cos(heading)], axis=-1)

    def place(self, along_m: float, lateral_m: float, height_m: float = 0.0) -> Float64:
        """Return ``T_street_object`` of an object at that position that faces along the road."""
        x, y = self.points(np.array([along_m]), np.array([lateral_m]))[0]
        return at(x, y, height_m, self.heading(along_m))

    def _in_lap(self, along_m: Any) -> Any:
        """Return distances within one lap; the end of the lap does not wrap to its start."""
        if self.loop_m is None:
            return along_m
        return np.where(along_m == self.loop_m, along_m, np.mod(along_m, self.loop_m))


def centre_line(settings: StreetScene, length_m: float) -> CentreLine:
    """Return the road from 60 m before the start to ``length_m`` after it, or around a block."""
    if settings.path == "block":
        return lap(*settings.block_m, CORNER_M)
    along = np.arange(-_BEFORE_M, length_m + _STEP_M, _STEP_M)
    rate = math.radians(settings.turn_deg_per_100m) / 100.0
    # A real road is not a perfect arc but winds slightly around it.
    winding = rate * along + 0.35 * rate * 18.0 * np.sin(along / 18.0)
    heading = np.zeros_like(along) if settings.path == "straight" else winding
    xy = _walk(along, heading)
    last = float(along[-1]) - _BARE_M
    span = (-BEHIND_M, last) if settings.repeat_m is None else (0.0, settings.repeat_m)
    return CentreLine(along, xy - xy[np.searchsorted(along, 0.0)], heading, span)


def _walk(along_m: Float64, heading_rad: Float64) -> Float64:
    middle = 0.5 * (heading_rad[:-1] + heading_rad[1:])
    steps = np.diff(along_m)[:, None] * np.stack([np.cos(middle), np.sin(middle)], axis=1)
    return np.vstack([np.zeros((1, 2)), np.cumsum(steps, axis=0)])


def lap(length_m: float, width_m: float, corner_m: float) -> CentreLine:
    """Return one lap around a block, counter-clockwise, from the start of a long side."""
    arc_m = 0.5 * math.pi * corner_m
    sides = [length_m - 2 * corner_m, width_m - 2 * corner_m] * 2
    ends = np.cumsum([[side, arc_m] for side in sides])
    knots = np.concatenate([[0.0], ends])
    turns = 0.5 * math.pi * np.repeat(np.arange(5), 2)[:-1]
    # The knots are samples too, so that each piece has its exact length and the lap closes.
    pieces = [np.linspace(a, b, int((b - a) / _STEP_M) + 2)[:-1] for a, b in pairwise(knots)]
    along = np.concatenate([*pieces, knots[-1:]])
    heading = np.interp(along, knots, turns)
    lap = float(knots[-1])
    return CentreLine(along, _walk(along, heading), heading, (0.0, lap), lap)


def camera_poses(settings: StreetScene, road: CentreLine) -> Float64:
    """Return ``T_street_camera`` (frames, 4, 4) of the left camera, street axes."""
    along = settings.speed_m_per_frame * np.arange(settings.frames)
    sway, phase, poses = settings.sway, 0.7 * (settings.seed % 997), []
    yaw, pitch, roll = np.radians([settings.yaw_deg, settings.pitch_deg, settings.roll_deg])
    for s in along.tolist():
        # The position of the car on the road, its small motions, and the mounting of the rig.
        drift = 0.2 * sway * math.sin(s / 11.0 + phase)
        slope = 0.2 * sway / 11.0 * math.cos(s / 11.0 + phase)
        nod = math.radians(0.25) * sway * math.sin(s / 3.1 + phase)
        tilt = math.radians(0.15) * sway * math.sin(s / 4.3 + 2.0 * phase)
        heave = 0.015 * sway * math.sin(s / 2.7 + 3.0 * phase)
        T = road.place(s, LANE_M + drift, settings.camera_height_m + heave)
        R = T[:3, :3] @ se3.exp_so3(np.array([0.0, 0.0, math.atan(slope)])) @ R_STREET_LEVEL
        for turn in ((0.0, yaw, 0.0), (-pitch - nod, 0.0, 0.0), (0.0, 0.0, roll + tilt)):
            R = R @ se3.exp_so3(np.array(turn))
        poses.append(se3.make_transform(R, T[:3, 3]))
    return np.stack(poses)
