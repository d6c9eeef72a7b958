"""Settings of the audit."""

from __future__ import annotations

from typing import Annotated

from pydantic import Field

from recon.core.settings import Settings
from recon.stereo.frame import StereoSettings

Metres = Annotated[float, Field(ge=0, le=1e6)]


class AuditSettings(Settings):
    """Whether and how thoroughly recordings are audited, and what is plausible."""

    quick: bool = Field(
        default=True,
        description="Whether `recon map`, `pair` and `disparity` start with a quick audit. Off "
        "saves a second.",
    )
    frames: int = Field(
        default=300,
        ge=2,
        le=1_000_000,
        description="Frames to read in all; on longer drives, in several runs. More finds what is "
        "rare.",
    )
    baseline_m: tuple[Metres, Metres] = Field(
        default=(0.01, 2.0),
        description="Smallest and largest plausible baseline, in metres. Widen it for an unusual "
        "rig.",
    )


class AuditedSettings(StereoSettings):
    """Settings of an audit, which rectifies and matches as a run does."""

    audit: AuditSettings = AuditSettings()
