"""Settings of a synthetic street drive and its cameras."""

from __future__ import annotations

from typing import Annotated, Any, Final, Literal

from pydantic import Field, model_validator
from typing_extensions import Self

from recon.core.settings import Settings

CORNER_M: Final = 16.0  # radius of the corners of a block
_IN_HAND: Final = {
    "height_px": 400, "baseline_m": 0.12, "pitch_deg": 8.0, "speed_m_per_frame": 0.1,
    "shutter": 0.1,
}  # fmt: skip

_LEAST_SIDE_M: Final = 2 * CORNER_M + 28.0  # two rows of houses, back to back
_SideM = Annotated[float, Field(ge=_LEAST_SIDE_M, le=2000.0)]


class StreetSettings(Settings):
    """A rendered street, the rig that drives through it, and how far.

    Equal settings give bit-identical images. A longer drive with the same seed continues along
    the same street.
    """

    seed: int = Field(0, ge=0, lt=2**31)
    """Seed of the street: another one, another street."""
    frames: int = Field(40, ge=1, le=2000)
    """Number of stereo pairs, a metre apart."""
    path: Literal["curve", "straight", "block", "room"] = "curve"
    """Shape of the street; block = repeated laps around a block, for loops; room = laps through a
    furnished room with mirrors and windows, a rig of 12 cm in the hand, frames 10 cm apart."""
    width_px: int = Field(640, ge=16, le=8192)
    """Image width. Take that of your rig to try it."""
    height_px: int = Field(240, ge=16, le=8192)
    """Image height."""
    focal_px: float = Field(360.0, ge=1.0, le=100000.0)
    """Focal length."""
    camera_height_m: float = Field(1.65, ge=0.3, le=4.0)
    """Height of the cameras above the road."""

    @model_validator(mode="before")
    @classmethod
    def _in_hand(cls, values: Any) -> Any:
        """What is not given is that of a hand-held rig, where the path is in a room."""
        if not isinstance(values, dict) or values.get("path") != "room":
            return values
        return {
            name: value for name, value in _IN_HAND.items() if name in cls.model_fields
        } | values


class StreetScene(StreetSettings):
    """A street in every detail; the defaults are those of `recon demo`."""

    #: Mean curvature of a curved street; positive = to the left.
    turn_deg_per_100m: float = Field(default=20.0, ge=-60.0, le=60.0)
    speed_m_per_frame: float = Field(default=1.0, ge=0.0, le=5.0)
    frame_rate_hz: float = Field(default=10.0, ge=1e-3, le=1e6)  # affects only the time stamps
    block_m: tuple[_SideM, _SideM] = (100.0, 70.0)  # sides of the block for path = block
    #: Period after which a straight street repeats itself; None = never.
    repeat_m: float | None = Field(default=None, ge=20.0, le=1000.0)
    #: Fences, railings, hedges, wires and shop windows instead of parked cars and furniture.
    fences: bool = False
    sway: float = Field(default=1.0, ge=0.0, le=5.0)  # of drift and pitching of the car; 0 = none
    baseline_m: float = Field(default=0.54, ge=0.001, le=5.0)
    pitch_deg: float = Field(default=1.0, ge=-30.0, le=30.0)  # of the mounted rig; positive = down
    yaw_deg: float = Field(default=1.5, ge=-45.0, le=45.0)  # of the mounted rig; positive = right
    roll_deg: float = Field(default=0.3, ge=-30.0, le=30.0)  # positive = clockwise
    #: Sensor noise, standard deviation in grey levels (0 to 255).
    noise_dn: float = Field(default=1.0, ge=0.0, le=50.0)
    #: Brightness of the right camera relative to the left, and grey levels added in its images.
    right_gain: float = Field(default=1.0, gt=0.0, le=4.0)
    right_offset_dn: float = Field(default=0.0, ge=-128.0, le=128.0)
    #: Fraction of the time between frames in which the shutter is open: what moves is blurred.
    shutter: float = Field(default=0.0, ge=0.0, le=1.0)
    smooth_edges: bool = True  # four rays instead of one per pixel at edges (antialiasing)
    #: Rendering threads, 0 = one per core; does not affect the result.
    threads: int = Field(default=0, ge=0, le=256)

    @classmethod
    def of(cls, settings: StreetSettings) -> StreetScene:
        """Return the scene of settings: themselves, or with the other details of a demo."""
        return settings if isinstance(settings, cls) else cls(**dict(settings))

    @model_validator(mode="after")
    def _check_shape(self) -> Self:
        if self.repeat_m is not None and self.path != "straight":
            raise ValueError("repeat_m: only a straight street can repeat itself")
        return self
