"""Settings of loop closure."""

from __future__ import annotations

from pydantic import Field

from recon.core.settings import Settings


class DriftSettings(Settings):
    """How far odometry may drift; larger values give more candidates and refuse less."""

    share: float = Field(
        0.02,
        gt=0.0,
        le=1.0,
        description="Standard deviation of a position, as a share of the path. Raise it where "
        "loops are missed because the path has drifted too far.",
    )
    turn_deg: float = Field(
        0.15,
        gt=0.0,
        le=10.0,
        description="Standard deviation of the heading after 1 m; grows with the root of the path. "
        "Raise it for a rig that turns fast.",
    )


class LoopSettings(Settings):
    """Loop closure: recognising a place, verifying it and correcting the path."""

    enabled: bool = Field(
        True,
        description="Look for loops and close them. Turn it off where the path has none, for "
        "speed.",
    )
    drift: DriftSettings = DriftSettings()
