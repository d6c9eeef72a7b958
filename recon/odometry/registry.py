"""The odometries by name."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any, Final

import numpy as np

from recon.core.errors import RegistrationError, SettingsError
from recon.core.geometry.se3 import invert
from recon.core.plugins import name_of
from recon.core.settings import scaled
from recon.core.text import counted
from recon.core.values import Trajectory
from recon.odometry.checked import CheckedOdometry
from recon.odometry.foreign import PLUGINS, ForeignOdometry
from recon.odometry.guide import Guide
from recon.odometry.kiss import RANGE_M, KissOdometry
from recon.odometry.prior import MotionPrior
from recon.odometry.protocol import Odometry, OdometryFrame, OdometryHealth, OdometryResult, pose_in
from recon.odometry.settings import OdometrySettings
from recon.odometry.visual import VisualOdometry

ODOMETRIES: Final[dict[str, Callable[[float, Guide | None], Odometry]]] = {
    "visual": lambda _, guide: VisualOdometry(guide),
    "kiss": lambda scale, guide: KissOdometry(scaled(RANGE_M, scale), VisualOdometry(guide)),
}
"""What makes each odometry, of the scale of the scene and what says how the rig moves."""


def make_odometry(
    odometry: str | Odometry,
    settings: OdometrySettings | None = None,
    prior: Trajectory | None = None,
    scale: float = 1.0,
    guide: Guide | None = None,
) -> Odometry:
    """Make the odometry of a name, ours or one that an installed package registers.

    An object with the methods of `Odometry` is taken too. Poses are checked (`CheckedOdometry`).

    Each odometry uses its own part of the settings; ``prior`` is the path of the rig by other
    sensors, on the clock of the frames, ``scale`` the size of the scene against a road;
    without a prior ``guide`` says how the rig moves: neither is of use to one that is not ours.
    """
    if odometry == "sfm":
        what, expected = "structure from motion is no odometry frame by frame", "visual or kiss"
        raise SettingsError(what, where="odometry.method", got=odometry, expected=expected)
    check_odometry(odometry)
    if not isinstance(odometry, str) or odometry not in ODOMETRIES:
        if prior is not None:
            where, hint = f"odometry {name_of(odometry)!r}", "leave out --prior"
            raise SettingsError("only odometries of recon take a prior", where=where, hint=hint)
        made = ForeignOdometry(PLUGINS.load(odometry), name_of(odometry))
        return CheckedOdometry(made, scale)
    settings = settings or OdometrySettings()
    guide = guide if prior is None else MotionPrior(prior, settings.prior)
    return CheckedOdometry(ODOMETRIES[odometry](scale, guide), scale)


def check_odometry(odometry: str | Odometry) -> None:
    """Check that an odometry exists, without making it."""
    PLUGINS.check(odometry, (*ODOMETRIES, "sfm"))


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
