"""Python API: matching and reconstruction of one stereo pair as plain functions."""

from __future__ import annotations

from typing import Any

from recon.formats.middlebury import stand_in_camera
from recon.matching import MATCHERS, field_of
from recon.pipeline.config import PAIR_DEFAULTS, ReconConfig, load_config
from recon.pipeline.frame import FrameReconstructor, ReconstructedFrame
from recon.structures import Disparity, RectifiedCamera, StereoCalibration, StereoPair
from recon.structures.arrays import UInt8

Calibration = RectifiedCamera | StereoCalibration


def match(
    left: UInt8,
    right: UInt8,
    calibration: Calibration | None = None,
    *,
    matcher: str = "sad",
    **settings: Any,
) -> Disparity:
    """Disparity of two images.

    Args:
        left: uint8 (H, W) grey or (H, W, 3) RGB.
        right: The same shape as ``left``.
        calibration: Needed if the images are not rectified; it also gives the disparity range.
        matcher: Name of the matcher: a key of `recon.matching.MATCHERS`.
        **settings: Settings of that matcher, such as ``ndisp=64`` or ``window_px=9``.

    Raises:
        ShapeError: The images differ in size.
        SettingsError: There is no such matcher, or a setting is unknown or out of its range.
    """
    height_px, width_px = left.shape[:2]
    own = {field_of(matcher): settings} if matcher in MATCHERS else {}
    config = ReconConfig.parse({"matching": {"matcher": matcher, **own}})
    camera = calibration or stand_in_camera(width_px, height_px)
    return FrameReconstructor(camera, config).match(StereoPair(left, right))[1]


def reconstruct(
    left: UInt8, right: UInt8, calibration: Calibration, config: ReconConfig | None = None
) -> ReconstructedFrame:
    """Rectified pair, disparity and cloud (camera axes, metres) of two images.

    Args:
        left: uint8 (H, W) grey or (H, W, 3) RGB.
        right: The same shape as ``left``.
        calibration: Of the two cameras.
        config: Settings of the stages; None = those of ``recon pair``.

    Raises:
        ReconError: The images, the calibration and the settings do not fit together.
    """
    settings = config or load_config(defaults=PAIR_DEFAULTS)
    return FrameReconstructor(calibration, settings).reconstruct(StereoPair(left, right))
