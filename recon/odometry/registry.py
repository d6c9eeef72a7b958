"""The odometries by name, and those that are not ours, whose poses and states are checked."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from typing import Any, Final

import numpy as np
from pydantic import TypeAdapter, ValidationError

from recon.core.errors import FormatError, RegistrationError, SettingsError
from recon.core.geometry.se3 import check_rigid, invert, orthonormalise
from recon.core.plugins import Plugins, calling, kind_of, name_of
from recon.core.settings import scaled
from recon.core.text import counted
from recon.core.values import Trajectory
from recon.core.values.arrays import Float64
from recon.odometry.checked import CheckedOdometry
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
        what, expected = "structure from motion does not run frame by frame", "visual or kiss"
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


PLUGINS: Final = Plugins(
    "odometry", "recon.odometries", ("register(frame)", "state()", "restore(state)")
)
_HEALTH: Final = TypeAdapter(OdometryHealth)
_FIRST_M: Final = 1e-6  # rounding apart, the first pose is the identity
_PLAIN: Final = (str, int, float, type(None))


class ForeignOdometry:
    """Checks what an odometry that is not ours returns."""

    def __init__(self, odometry: Odometry, name: str) -> None:
        self._odometry, self._where = odometry, f"odometry {name!r}"
        self._begun = False

    def register(self, frame: OdometryFrame) -> OdometryResult:
        where = f"{self._where}, frame {frame.pair.index}"
        found = self._call(self._odometry.register, frame, where=where)
        if not isinstance(found, OdometryResult):
            what, hint = "the odometry returns no pose", "return recon.OdometryResult(T)"
            raise RegistrationError(what, where=where, got=kind_of(found), hint=hint)
        T = self._pose(found.T_world_camera, where)
        try:
            health = _HEALTH.validate_python(vars(found.health))
        except (ValidationError, TypeError) as error:
            what, got = "odometry returned an invalid OdometryHealth", repr(found.health)
            raise RegistrationError(what, where=where, got=got) from error
        self._begun = True
        return OdometryResult(T, health)

    def state(self) -> dict[str, Any]:
        own = self._call(self._odometry.state, where=self._where)
        if not isinstance(own, Mapping) or not _storable(own):
            what, got = "the state of the odometry cannot be stored", kind_of(own)
            expected = "a dict of arrays, texts and numbers of Python, also in dicts and lists"
            raise RegistrationError(what, where=self._where, got=got, expected=expected)
        return {"own": dict(own), "begun": self._begun}

    def restore(self, state: dict[str, Any]) -> None:
        self._call(self._odometry.restore, state["own"], where=self._where)
        self._begun = bool(state["begun"])

    def _call(self, method: Callable[..., Any], *given: Any, where: str) -> Any:
        with calling(RegistrationError, "the odometry fails", where=where):
            return method(*given)

    def _pose(self, given: Any, where: str) -> Float64:
        """Return a pose with an exact rotation."""
        try:
            T = np.array(given, dtype=np.float64)
            check_rigid("the pose", T)
        except (FormatError, ValueError, TypeError) as error:
            what = "the odometry returns no rigid pose"
            got = error.got if isinstance(error, FormatError) else kind_of(given)
            expected = "float (4, 4): a rotation and metres, last row 0 0 0 1"
            raise RegistrationError(what, where=where, got=got, expected=expected) from error
        if not self._begun and np.abs(T - np.eye(4)).max() > _FIRST_M:
            what, expected = "the first pose is not the identity", "T_first_camera"
            raise RegistrationError(what, where=where, got=T.tolist(), expected=expected)
        return orthonormalise(T)


def _storable(value: Any) -> bool:
    if isinstance(value, Mapping):
        return all(isinstance(name, str) for name in value) and all(map(_storable, value.values()))
    if isinstance(value, np.ndarray):
        return value.dtype.kind in "biuf"
    if isinstance(value, list | tuple):
        return all(map(_storable, value))
    return isinstance(value, _PLAIN)
