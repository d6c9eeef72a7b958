"""Settings of `recon paper`."""

from __future__ import annotations

from pydantic import Field, field_validator

from recon.core.settings import Settings
from recon.stereo.settings import StereoSettings


class PaperSettings(Settings):
    """How the seed paper's experiments are repeated."""

    as_printed: bool = Field(
        default=False, description="Run the method as printed as well as the corrected one."
    )
    patch_px: int = Field(
        default=11,
        ge=3,
        le=61,
        description="Patch size of the printed method, odd. The paper does not give one: try "
        "others.",
    )
    patches_px: tuple[int, ...] = Field(
        default=tuple(range(3, 22, 2)),
        min_length=1,
        description="Patch sizes, and window sizes of the matcher `sad`, to compare; odd.",
    )

    @field_validator("patch_px", "patches_px")
    @classmethod
    def _are_odd(cls, value: int | tuple[int, ...]) -> int | tuple[int, ...]:
        patches = (value,) if isinstance(value, int) else value
        if any(patch % 2 == 0 or not 1 <= patch <= 61 for patch in patches):
            raise ValueError("a patch is an odd number from 1 to 61")
        return value


class PaperConfig(StereoSettings):
    """Settings of `recon paper`, which corrects the printed method with ours."""

    paper: PaperSettings = PaperSettings()
