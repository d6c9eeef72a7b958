"""The odometries by name."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any, Final

import numpy as np

from recon.core.errors import RegistrationError, SettingsError
from recon.core.geometry.se3 import invert
from recon.core.text import counted
from recon.core.values import Trajectory
from recon.odometry.checked import CheckedOdometry
from recon.odometry.guide import Guide
from recon.odometry.kiss import KissOdometry
from recon.odometry.prior import MotionPrior
from recon.odometry.protocol import Odometry, OdometryFrame, OdometryHealth, OdometryResult, pose_in
from recon.odometry.settings import OdometrySettings
from recon.odometry.visual import VisualOdometry

ODOMETRIES: Final[dict[str, Callable[[OdometrySettings, Guide | None], Odometry]]] = {
    "visual": lambda settings, guide: VisualOdometry(guide),
    "kiss": lambda settings, guide: KissOdometry(settings.max_range_m, VisualOdometry(guide)),
}


def make_odometry(
    name: str,
    settings: OdometrySettings | None = None,
    prior: Trajectory | None = None,
    scale: float = 1.0,
    guide: Guide | None = None,
) -> Odometry:
    """Make the odometry of a name in `ODOMETRIES`; its poses are checked (`CheckedOdometry`).

    Each odometry uses its own part of the settings; ``prior`` is the path of the rig by other
    sensors, on the clock of the frames, ``scale`` the size of the scene against a road;
    without a prior ``guide`` says how the rig moves.
    """
    if name == "sfm":
        what, expected = "structure from motion is no odometry frame by frame", "visual or kiss"
        raise SettingsError(what, where="odometry.method", got=name, expected=expected)
    if name not in ODOMETRIES:
        choices = ", ".join(sorted(ODOMETRIES))
        raise SettingsError("unknown odometry", got=repr(name), expected=f"one of: {choices}")
    settings = settings or OdometrySettings()
    guide = guide if prior is None else MotionPrior(prior, settings.prior)
    return CheckedOdometry(ODOMETRIES[name](settings, guide), scale)


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
        return {"T_first_world": self._T_first_world, "begun": self._begun}

    def restore(self, state: dict[str, Any]) -> None:
        self._T_first_world, self._begun = pose_in(state, "T_first_world"), bool(state["begun"])
