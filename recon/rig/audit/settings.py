"""Settings of the audit: sample size, and the limits of its findings."""

from __future__ import annotations

from pydantic import Field

from recon.core.settings import Settings
from recon.core.values import LARGEST_CENTRE_OFFSET
from recon.stereo.settings import StereoSettings


class AuditSettings(Settings):
    """Sample size and limits of an audit."""

    def for_quick_look(self) -> AuditSettings:
        """The same limits with a smaller sample, for a check of a second or two."""
        fewer = {"features": min(self.features, 800), "max_lag": min(self.max_lag, 3)}
        return self.model_copy(update=fewer)

    quick: bool = Field(
        default=True,
        description="Whether `recon map`, `pair` and `disparity` start with a quick audit.",
    )
    frames: int = Field(
        default=300, ge=2, description="Frames to read in all; on longer drives, in several runs."
    )
    runs: int = Field(
        default=6, ge=1, description="Number of runs of consecutive frames on longer drives."
    )
    pairs: int = Field(default=12, ge=1, description="Pairs in which features are matched.")
    features: int = Field(
        default=1500, ge=100, le=20000, description="Maximum number of features per image."
    )
    min_features: int = Field(
        default=60, ge=20, description="Minimum number of features, in all, to judge geometry."
    )
    max_lag: int = Field(
        default=4, ge=0, description="Largest delay of one camera to look for, in frames."
    )
    swapped_share: float = Field(
        default=0.8,
        gt=0.5,
        le=1,
        description="Share of negative disparities from which the cameras count as swapped.",
    )
    row_px: float = Field(
        default=0.75, gt=0, description="Rms row error above which it is reported, in pixels."
    )
    bad_row_px: float = Field(
        default=1.5, gt=0, description="Rms row error above which that finding is fatal, in pixels."
    )
    gain: float = Field(
        default=1.2, gt=1, description="Brightness ratio above which a finding is reported."
    )
    sharpness_ratio: float = Field(
        default=0.65,
        gt=0,
        lt=1,
        description="One camera counts as blurred below this sharpness relative to the other.",
    )
    sharpness: float = Field(
        default=0.14, gt=0, lt=1, description="Both cameras count as blurred below this sharpness."
    )
    contrast_dn: float = Field(
        default=4.0,
        gt=0,
        description="An image counts as blank below this standard deviation, in grey levels.",
    )
    repeated_share: float = Field(
        default=0.02, ge=0, lt=1, description="Share of repeated frames that is still accepted."
    )
    frozen_frames: int = Field(
        default=3, ge=2, description="Repeats in a row from which one camera counts as frozen."
    )
    gap_periods: float = Field(
        default=1.7,
        gt=1,
        description="Time step, in frame periods, above which frames count as missing.",
    )
    skew_frames: float = Field(
        default=0.1,
        gt=0,
        description="Time skew between the cameras above which it is reported, in frames.",
    )
    near_share: float = Field(
        default=0.02,
        ge=0,
        lt=1,
        description="Share of features beyond the disparity range above which they are reported.",
    )
    far_px: float = Field(
        default=1.5,
        gt=0,
        description="A scene with a smaller median disparity is too far for the baseline.",
    )
    baseline_m: tuple[float, float] = Field(
        default=(0.01, 2.0), description="Smallest and largest plausible baseline, in metres."
    )
    max_speed_m_per_s: float = Field(
        default=70.0, gt=0, description="A higher apparent speed means that the baseline is wrong."
    )
    centre_share: float = Field(
        default=LARGEST_CENTRE_OFFSET,
        gt=0,
        lt=0.5,
        description="Offset of the principal point from the image centre, relative to the image "
        "size, above which the calibration is of another image size.",
    )


class AuditedSettings(StereoSettings):
    """Settings of an audit, which rectifies and matches as a run does."""

    audit: AuditSettings = AuditSettings()
