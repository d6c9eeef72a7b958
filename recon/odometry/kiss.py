"""kiss-icp alone, on the points that stereo measures well."""

from __future__ import annotations

from typing import Any, Final

import numpy as np

from recon.core.geometry.se3 import invert
from recon.core.values.arrays import Float64
from recon.core.words import counted
from recon.odometry.icp_points import select_points
from recon.odometry.kiss_icp import KissIcp, KissIcpOptions
from recon.odometry.protocol import OdometryFrame, OdometryHealth, OdometryResult, pose_in

_VOXEL_M: Final = 0.2
"""Edge of a voxel of the map."""

_MIN_POINTS: Final = 300
"""Frames with fewer points are skipped."""


class KissOdometry:
    """Gives kiss-icp the points that stereo measures well; it has a motion model of its own.

    With every point, as of a LiDAR, it underestimates motion by half (`select_points`).

    Args:
        max_range_m: Farther points are not used.
    """

    def __init__(self, max_range_m: float) -> None:
        self._max_range_m = max_range_m
        self._icp = KissIcp(KissIcpOptions(max_range_m, _VOXEL_M))
        self._poses: list[Float64] = []

    def register(self, frame: OdometryFrame) -> OdometryResult:
        """Register the next frame; one with too few points is extrapolated."""
        points = select_points(frame, self._max_range_m)
        if len(points) < _MIN_POINTS:
            note = f"too few for ICP: {counted(len(points), 'point')}; the last motion goes on"
            first = not self._poses
            health = OdometryHealth(first, skipped=not first, icp_points=len(points), notes=(note,))
            return self._keep(self._extrapolated(), health)
        alignment = self._icp.register(points.xyz)
        health = OdometryHealth(icp_points=len(alignment.source))
        return self._keep(alignment.T_world_camera, health)

    def state(self) -> dict[str, Any]:
        """Return everything that later poses depend on."""
        return {"icp": self._icp.state(), "poses": [{"T": pose} for pose in self._poses]}

    def restore(self, state: dict[str, Any]) -> None:
        """Continue from a `state`."""
        self._icp.restore(state["icp"])
        self._poses = [pose_in(pose, "T") for pose in state["poses"]]

    def _keep(self, T_world_camera: Float64, health: OdometryHealth) -> OdometryResult:
        self._poses = [*self._poses[-1:], T_world_camera]
        return OdometryResult(T_world_camera, health)

    def _extrapolated(self) -> Float64:
        """Return the last pose, moved by the last motion."""
        if len(self._poses) < 2:
            return self._poses[-1] if self._poses else np.eye(4)
        before, last = self._poses
        return np.asarray(last @ invert(before) @ last)
