"""What a look at a drive can be set to."""

from __future__ import annotations

from typing import Annotated

from pydantic import Field

from recon.core.settings import Settings
from recon.stereo.frame import StereoSettings

Metres = Annotated[float, Field(ge=0, le=1e6)]


class AuditSettings(Settings):
    """Whether and how thoroughly recordings are audited, and what is plausible."""

    quick: bool = True
    """Whether `recon map`, `localize`, `pair` and `disparity` say what is wrong with a recording.
    Off: they look at the rig alone."""
    baseline_m: tuple[Metres, Metres] = Field((0.01, 2.0))
    """Smallest and largest plausible baseline, in metres. Widen it for an unusual rig."""


class AuditedSettings(StereoSettings):
    """Settings of an audit, which rectifies and matches as a run does."""

    audit: AuditSettings = AuditSettings()
