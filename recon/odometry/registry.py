"""The odometries by name."""

from __future__ import annotations

from collections.abc import Callable
from typing import Final

from recon.errors import SettingsError
from recon.odometry.checked import CheckedOdometry
from recon.odometry.fused import FusedOdometry
from recon.odometry.kiss import KissOdometry
from recon.odometry.protocol import Odometry
from recon.odometry.settings import OdometrySettings
from recon.odometry.visual import VisualOdometry

ODOMETRIES: Final[dict[str, Callable[[OdometrySettings], Odometry]]] = {
    "visual": lambda settings: VisualOdometry(settings.visual),
    "kiss": lambda settings: KissOdometry(settings.kiss),
    "fused": lambda settings: FusedOdometry(settings.fused, settings.visual),
}


def make_odometry(name: str, settings: OdometrySettings | None = None) -> Odometry:
    """Make the odometry of a name; it doubts its poses.

    Args:
        name: A key of `ODOMETRIES`.
        settings: The settings of all odometries; each takes its own part.

    Raises:
        SettingsError: There is no such odometry.
    """
    if name not in ODOMETRIES:
        choices = ", ".join(sorted(ODOMETRIES))
        raise SettingsError("unknown odometry", got=repr(name), expected=f"one of: {choices}")
    settings = settings or OdometrySettings()
    return CheckedOdometry(ODOMETRIES[name](settings), settings.trust)
