"""Settings of loop closure."""

from __future__ import annotations

from pydantic import Field

from recon.core.settings import Settings


class LoopSettings(Settings):
    """Loop closure: recognising a place, verifying it and correcting the path."""

    enabled: bool = Field(
        True,
        description="Look for loops and close them. Turn it off where the path has none, for "
        "speed.",
    )
