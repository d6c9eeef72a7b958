"""Python API: matching and reconstruction of one stereo pair as plain functions."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

from recon.commands.config import PAIR_DEFAULTS, ReconConfig, load_config
from recon.core.errors import SettingsError
from recon.core.values import Disparity, RectifiedCamera, StereoCalibration, StereoPair
from recon.core.values.arrays import UInt8
from recon.io.cameras.calibration import read_calibration
from recon.io.files import StrPath
from recon.io.middlebury import stand_in_camera
from recon.stereo.frame import FrameReconstructor, ReconstructedFrame
from recon.stereo.match.protocol import Matcher, name_of
from recon.stereo.match.registry import MATCHERS, check_matcher, field_of

_Rig = RectifiedCamera | StereoCalibration
Calibration = RectifiedCamera | StereoCalibration | StrPath


def match(
    left: UInt8,
    right: UInt8,
    calibration: Calibration | None = None,
    *,
    matcher: str | Matcher = "sad",
    **settings: Any,
) -> Disparity:
    """Match two images: return their disparity.

    Args:
        left: uint8 (H, W) grey or (H, W, 3) RGB.
        right: The same shape as ``left``.
        calibration: Needed if the images are not rectified; it also gives the disparity range.
            A value, or a file that `read_calibration` understands.
        matcher: Name of the matcher, one of recon's or one that an installed package registers;
            or any object with the methods of `Matcher`.
        **settings: Settings of a matcher of recon's, such as ``ndisp=64`` or ``window_px=9``.

    Raises:
        ShapeError: The images differ in size.
        SettingsError: There is no such matcher, or a setting is unknown or out of its range.
        MatchingError: A matcher that is not recon's fails, or returns no disparity of the pair.
    """
    config = ReconConfig.parse({"matching": _own_settings(matcher, settings)}).with_matcher(matcher)
    pair = StereoPair(left, right)
    height_px, width_px = pair.left.shape[:2]
    if calibration is None:
        camera: _Rig = stand_in_camera(width_px, height_px)
    else:
        camera = _rig_of(calibration, pair)
    return FrameReconstructor(camera, config).match(pair)[1]


def reconstruct(
    left: UInt8,
    right: UInt8,
    calibration: Calibration,
    config: ReconConfig | None = None,
    *,
    matcher: str | Matcher | None = None,
) -> ReconstructedFrame:
    """Reconstruct two images: rectified pair, disparity and cloud (camera axes, metres).

    Args:
        left: uint8 (H, W) grey or (H, W, 3) RGB.
        right: The same shape as ``left``.
        calibration: Of the two cameras: a value, or a file that `read_calibration` understands.
        config: Settings of the stages; None = those of ``recon pair``.
        matcher: As for `match`; None = that of the settings.

    Raises:
        ReconError: The images, the calibration and the settings do not fit together.
    """
    settings = (config or load_config(defaults=PAIR_DEFAULTS)).with_matcher(matcher)
    pair = StereoPair(left, right)
    return FrameReconstructor(_rig_of(calibration, pair), settings).reconstruct(pair)


def _rig_of(calibration: Calibration, pair: StereoPair) -> _Rig:
    """Return the calibration, read for images of this size if it is a file."""
    if isinstance(calibration, RectifiedCamera | StereoCalibration):
        return calibration
    height_px, width_px = pair.left.shape[:2]
    return read_calibration(calibration, width_px, height_px)


def _own_settings(matcher: str | Matcher, settings: Mapping[str, Any]) -> dict[str, Any]:
    """Return the settings of one matcher as a part of those of all."""
    if isinstance(matcher, str) and matcher in MATCHERS:
        return {field_of(matcher): settings}
    if settings:
        check_matcher(matcher)
        raise SettingsError(
            "only recon's own matchers take settings",
            where=f"matcher {name_of(matcher)!r}",
            got=", ".join(settings),
            hint="make the object with them",
        )
    return {}
