"""An odometry whose poses are checked: uncertain and contradicted ones are marked."""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import Any, Final

import numpy as np

from recon.core.geometry.se3 import invert
from recon.core.values import Disparity, RectifiedCamera
from recon.core.values.arrays import Float64
from recon.core.words import counted
from recon.odometry.agreement import Sight, explain_motion
from recon.odometry.protocol import (
    Odometry,
    OdometryFrame,
    OdometryHealth,
    OdometryResult,
    pose_in,
    tree_of,
)

_MAX_SIGMA_M: Final = 0.05
"""Largest standard deviation of a trusted motion."""

_MAX_SIGMA_SHARE: Final = 0.05
"""Share of the motion's length that is added to it."""

_MIN_TELLING: Final = 8
"""With fewer usable patches the images say nothing."""

MIN_SHARE: Final = 0.6
"""Least share of patches that must agree with a trusted motion."""


@dataclass(frozen=True, eq=False)
class CheckedState:
    """What is kept from frame to frame.

    Attributes:
        sight: The last frame.
        T_world_camera: float64 (4, 4), its pose.
    """

    sight: Sight
    T_world_camera: Float64


class CheckedOdometry:
    """Checks how certain every motion is, and whether the image agrees with it.

    Poses stay as they are; ``health.ok`` and its notes say which are not to be trusted.

    Args:
        odometry: Finds the poses.
    """

    def __init__(self, odometry: Odometry) -> None:
        self._odometry = odometry
        self._state: CheckedState | None = None

    def register(self, frame: OdometryFrame) -> OdometryResult:
        """Register the next frame, and check the result."""
        result, state = self._odometry.register(frame), self._state
        sight = Sight(frame.pair.left, frame.disparity)
        self._state = CheckedState(sight, result.T_world_camera)
        if state is None or not result.health.ok:
            return result
        T_before_now = invert(state.T_world_camera) @ result.T_world_camera
        views = (state.sight, sight)
        doubts = self._doubts(result.health, views, T_before_now, frame.pair.camera)
        notes = (*result.health.notes, *doubts)
        return replace(result, health=replace(result.health, ok=not doubts, notes=notes))

    def state(self) -> dict[str, Any]:
        """Return everything that later poses depend on."""
        last = self._state
        if last is None:
            return {"odometry": self._odometry.state(), "last": None}
        return {
            "odometry": self._odometry.state(),
            "last": {
                "left": last.sight.left,
                "disparity": tree_of(last.sight.disparity),
                "T_world_camera": last.T_world_camera,
            },
        }

    def restore(self, state: dict[str, Any]) -> None:
        """Continue from a `state`."""
        self._odometry.restore(state["odometry"])
        last, self._state = state["last"], None
        if last is not None:
            sight = Sight(last["left"], Disparity(**last["disparity"]))
            self._state = CheckedState(sight, pose_in(last, "T_world_camera"))

    def _doubts(
        self,
        health: OdometryHealth,
        views: tuple[Sight, Sight],
        T_before_now: Float64,
        camera: RectifiedCamera,
    ) -> list[str]:
        """Return what speaks against a motion; empty where it is to be trusted."""
        length_m = float(np.linalg.norm(T_before_now[:3, 3]))
        if health.sigma_m > _MAX_SIGMA_M + _MAX_SIGMA_SHARE * length_m:
            return [f"the motion is known to {health.sigma_m:.2f} m only"]
        found = explain_motion(*views, T_before_now, camera)
        if found.informative >= _MIN_TELLING:
            return _contradiction(found.share, found.informative)
        # A visual motion has passed the test of its uncertainty; any other has no other evidence.
        if np.isfinite(health.sigma_m):
            return []
        patches = counted(found.informative, "patch", "patches")
        return [f"only {patches} of the image can distinguish motions"]


def _contradiction(share: float, informative: int) -> list[str]:
    if share >= MIN_SHARE:
        return []
    patches = counted(informative, "patch", "patches")
    return [f"only {100 * share:.0f} % of {patches} of the image moved like that"]
