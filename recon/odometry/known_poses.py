"""Known poses in place of an odometry."""

from __future__ import annotations

from typing import Any

import numpy as np

from recon.core.errors import RegistrationError
from recon.core.geometry.se3 import invert
from recon.core.values import Trajectory
from recon.core.words import counted
from recon.odometry.protocol import OdometryFrame, OdometryHealth, OdometryResult, pose_in


class KnownPoses:
    """An odometry that looks poses up by the number of the frame.

    Args:
        trajectory: One pose for each frame of the source. They are re-based, so that the first
            frame that is registered stands at the identity.
    """

    def __init__(self, trajectory: Trajectory) -> None:
        self._poses = trajectory.T_world_camera
        self._T_first_world = np.eye(4)
        self._begun = False

    def register(self, frame: OdometryFrame) -> OdometryResult:
        """Return the known pose of the frame."""
        index = frame.pair.index
        if not 0 <= index < len(self._poses):
            raise RegistrationError(
                "no known pose for this frame",
                where=f"frame {index}",
                got=counted(len(self._poses), "pose"),
                expected="one for each frame",
                hint="the pose file must list every frame of the source",
            )
        if not self._begun:
            self._T_first_world = invert(self._poses[index])
            self._begun = True
        return OdometryResult(self._T_first_world @ self._poses[index], OdometryHealth(known=True))

    def state(self) -> dict[str, Any]:
        """Return everything that later poses depend on."""
        return {"T_first_world": self._T_first_world, "begun": self._begun}

    def restore(self, state: dict[str, Any]) -> None:
        """Continue from a `state`."""
        self._T_first_world, self._begun = pose_in(state, "T_first_world"), bool(state["begun"])
