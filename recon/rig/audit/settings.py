"""Settings of the audit."""

from __future__ import annotations

from pydantic import Field

from recon.core.settings import Settings
from recon.stereo.settings import StereoSettings


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
        description="Frames to read in all; on longer drives, in several runs. More finds what is "
        "rare.",
    )
    baseline_m: tuple[float, float] = Field(
        default=(0.01, 2.0),
        description="Smallest and largest plausible baseline, in metres. Widen it for an unusual "
        "rig.",
    )


class AuditedSettings(StereoSettings):
    """Settings of an audit, which rectifies and matches as a run does."""

    audit: AuditSettings = AuditSettings()
