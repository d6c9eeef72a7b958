"""How closely an input is looked at, and from where on something is said."""

from __future__ import annotations

from pydantic import Field

from recon.settings import Settings


class AuditSettings(Settings):
    """Samples and limits of an audit."""

    def for_quick_look(self) -> AuditSettings:
        """The same limits on few samples: what takes a second or two."""
        fewer = {"features": min(self.features, 800), "max_lag": min(self.max_lag, 3)}
        return self.model_copy(update=fewer)

    quick: bool = Field(
        default=True,
        description="Whether `recon map`, `pair`, `disparity` look at their input first.",
    )
    frames: int = Field(
        default=300, ge=2, description="Frames looked at in all; of longer drives in several runs."
    )
    runs: int = Field(default=6, ge=1, description="Stretches of a drive that is longer.")
    pairs: int = Field(default=12, ge=1, description="Pairs whose features are matched.")
    features: int = Field(default=1500, ge=100, le=20000, description="Features per picture.")
    min_features: int = Field(
        default=60, ge=20, description="Fewer in all tell nothing about geometry."
    )
    max_lag: int = Field(default=4, ge=0, description="Frames by which one camera may be late.")
    swapped_share: float = Field(
        default=0.8, gt=0.5, le=1, description="Negative disparities from which eyes are swapped."
    )
    row_px: float = Field(default=0.75, gt=0, description="Row error, rms, that is told.")
    bad_row_px: float = Field(
        default=1.5, gt=0, description="Row error from which a matcher finds little."
    )
    gain: float = Field(
        default=1.2, gt=1, description="Ratio of brightness of the cameras that is told."
    )
    sharpness_ratio: float = Field(
        default=0.65, gt=0, lt=1, description="Sharpness of one camera by the other's that is told."
    )
    sharpness: float = Field(
        default=0.14, gt=0, lt=1, description="Sharpness of both cameras that is told."
    )
    contrast_dn: float = Field(
        default=4.0, gt=0, description="Standard deviation of a picture that shows nothing."
    )
    repeated_share: float = Field(
        default=0.02, ge=0, lt=1, description="Share of repeated frames that is told."
    )
    frozen_frames: int = Field(default=3, ge=2, description="Repeats of one camera in a row.")
    gap_periods: float = Field(
        default=1.7, gt=1, description="Step of time, in usual ones, at which frames are missing."
    )
    skew_frames: float = Field(
        default=0.1, gt=0, description="Skew between the cameras, in frames, that is told."
    )
    near_share: float = Field(
        default=0.02, ge=0, lt=1, description="Features nearer than the search that are told."
    )
    far_px: float = Field(
        default=1.5, gt=0, description="Median disparity of a scene too far for the baseline."
    )
    baseline_m: tuple[float, float] = Field(
        default=(0.01, 2.0), description="Baselines that rigs have."
    )
    max_speed_m_per_s: float = Field(
        default=70.0, gt=0, description="Motion that tells of a baseline too long."
    )
    centre_share: float = Field(
        default=0.25,
        gt=0,
        lt=0.5,
        description="Distance of the principal point from the middle, by the size of the picture, "
        "at which a calibration is of another size.",
    )
