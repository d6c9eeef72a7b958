"""The odometries by name."""

from __future__ import annotations

from collections.abc import Callable
from typing import Final

from recon.core.errors import SettingsError
from recon.core.values import Trajectory
from recon.odometry.checked import CheckedOdometry
from recon.odometry.kiss import KissOdometry
from recon.odometry.prior import MotionPrior
from recon.odometry.protocol import Odometry
from recon.odometry.settings import OdometrySettings
from recon.odometry.visual import VisualOdometry

ODOMETRIES: Final[dict[str, Callable[[OdometrySettings, MotionPrior | None], Odometry]]] = {
    "visual": lambda settings, prior: VisualOdometry(prior),
    "kiss": lambda settings, prior: KissOdometry(settings.max_range_m),
}


def make_odometry(
    name: str, settings: OdometrySettings | None = None, prior: Trajectory | None = None
) -> Odometry:
    """Make the odometry of a name; its poses are checked (`CheckedOdometry`).

    Args:
        name: A key of `ODOMETRIES`.
        settings: The settings of all odometries; each uses its own part.
        prior: Path of the rig by other sensors, on the clock of the frames; None = not known.
    """
    if name not in ODOMETRIES:
        choices = ", ".join(sorted(ODOMETRIES))
        raise SettingsError("unknown odometry", got=repr(name), expected=f"one of: {choices}")
    if name == "kiss" and prior is not None:
        raise SettingsError(
            "kiss takes no prior", expected="visual", hint="drop --prior or --odometry"
        )
    settings = settings or OdometrySettings()
    motion_prior = None if prior is None else MotionPrior(prior, settings.prior)
    return CheckedOdometry(ODOMETRIES[name](settings, motion_prior))
