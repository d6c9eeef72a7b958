"""What calibration and audit can be set to."""

from __future__ import annotations

from typing import Literal

from pydantic import Field

from recon.core.settings import Settings
from recon.stereo.frame import StereoSettings

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
