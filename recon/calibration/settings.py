"""How a rig is calibrated."""

from __future__ import annotations

from typing import Literal

from pydantic import Field

from recon.settings import Settings

LensKind = Literal["radtan", "rational", "fisheye"]


class CalibrationSettings(Settings):
    """Lens, what counts as an outlier, and how sure one must be."""

    model: LensKind = Field(
        default="radtan",
        description="Radtan = radial and tangential (most lenses), rational = wide lenses, "
        "fisheye = by angle (150 degrees and more).",
    )
    radial_terms: Literal[2, 3] = Field(
        default=3, description="Radial coefficients of radtan: k1 k2, or k1 k2 k3."
    )
    outlier_ratio: float = Field(
        default=3.0,
        gt=1,
        description="A view whose error is so many times the median of all views is dropped.",
    )
    outlier_px: float = Field(
        default=0.3, ge=0, description="… but none whose error is below this, rms pixels."
    )
    min_views: int = Field(default=5, ge=3, description="Fewer views with the board are refused.")
    max_rms_px: float = Field(
        default=2.0, gt=0, description="A result that fits worse than this is refused."
    )
    bootstrap: int = Field(default=500, ge=50, description="Resamplings of the views.")
    confidence: float = Field(
        default=0.95, gt=0.5, lt=1, description="Share of the resamplings that intervals hold."
    )
    depths_m: tuple[float, ...] = Field(
        default=(2.0, 5.0, 10.0, 20.0), description="Depths at which errors are told."
    )
    match_sigma_px: float = Field(
        default=0.25, gt=0, description="Error of a match, for the depth error that comes with it."
    )
    seed: int = Field(default=0, ge=0, description="Of the resampling.")
