"""What calibration and audit can be set to."""

from __future__ import annotations

from typing import Annotated, Literal

from pydantic import Field

from recon.core.settings import Settings
from recon.stereo.frame import StereoSettings

Metres = Annotated[float, Field(ge=0, le=1e6)]


class AuditSettings(Settings):
    """Whether and how thoroughly recordings are audited, and what is plausible."""

    quick: bool = True
    """Whether `recon map`, `localize`, `pair` and `disparity` start with a quick audit. Off saves a
    second."""
    baseline_m: tuple[Metres, Metres] = Field((0.01, 2.0))
    """Smallest and largest plausible baseline, in metres. Widen it for an unusual rig."""


class AuditedSettings(StereoSettings):
    """Settings of an audit, which rectifies and matches as a run does."""

    audit: AuditSettings = AuditSettings()


LensKind = Literal["radtan", "rational", "fisheye"]


class CalibrationSettings(Settings):
    """Lens model, acceptance and uncertainty."""

    model: LensKind = "radtan"
    """Lens model: radtan (radial and tangential, most lenses), rational (wide angle) or fisheye
    (150 degrees or more)."""
    radial_terms: Literal[2, 3] = 3
    """Number of radial coefficients of radtan: k1 k2, or k1 k2 k3. 2 where the corners of the
    images hold no board, or for programs that know no k3."""
    working_m: float | None = Field(None, ge=0.001, le=1000000.0)
    """Distance for which the verdict is made, in metres; none = where the expected error of
    matching is 2 % of the distance."""


class CalibratedSettings(StereoSettings):
    """Settings of a calibration, whose views are rectified as a run does."""

    calibration: CalibrationSettings = CalibrationSettings()
