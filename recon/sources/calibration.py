"""Finds the calibration of a source, and whether its images are already rectified."""

from __future__ import annotations

import re
from pathlib import Path
from typing import Final

import numpy as np

from recon.core.errors import CalibrationError, SettingsError, SourceError
from recon.core.values import RectifiedCamera, Rig, StereoCalibration
from recon.io.cameras.calibration import read_calibration
from recon.sources.settings import SourceSettings

_NAMES: Final = (  # of calibrations, the surest first
    r"(calib|calibration|rig|stereo|cam_?chain|intrinsics|cameras?)([._-].*)?\.(txt|ya?ml|xml|json)",
    r"(calib|calibration|stereo)([._-].*)?\.(npz|mat)|sn\d+\.conf|k\.txt|left\.ya?ml",
    r".*[._-](calib|calibration|intrinsics)\.(txt|ya?ml|xml|json|npz|mat)",
)
RIG_FILE: Final = "rig.yaml"  # the refined calibration, in the folder of a run
# Focal lengths, skew and principal row: all of a camera matrix but the principal column.
_ROWS: Final = ([0, 0, 1, 1], [0, 1, 1, 2])
_DIGITS_TOLERANCE: Final = 1e-9  # deviation from a rectified pair, given the digits of files
# What to do where a source lacks a calibration.
CALIBRATE: Final = (
    "name one with --calib FILE; of rectified images (recon rectify makes them of two folders) "
    "--focal PX and --baseline M are enough"
)
_WIDEST_DEG: Final = 165.0  # flat images see no more: pixels at the side would be 60 times as wide


def read_rig(
    settings: SourceSettings,
    folder: Path,
    size: tuple[int, int],
    cameras: tuple[int, int] | None = None,
) -> tuple[Rig, tuple[Path, ...]]:
    """Return the calibration of the settings, else of a folder, for images of a size; its files."""
    check_given_once(settings.calibration, settings)
    if settings.numbers:
        return camera_of_numbers(settings, size), ()
    place = Path(settings.calibration or folder)
    named = settings.calibration is not None and not place.is_dir()
    path = place if named else find_calibration(place)
    if path is None:
        expected = "calib.txt, calibration.yaml, … in the folder"
        raise SourceError("calibration is missing", where=folder, expected=expected, hint=CALIBRATE)
    rig = read_calibration(path, *size, metres_per_unit=settings.metres_per_unit, cameras=cameras)
    return as_rectified(rig), (path,)


def check_given_once(calibration: object, settings: SourceSettings) -> None:
    """Refuse a camera that is given both by a calibration file and in numbers."""
    if calibration is not None and settings.numbers:
        what = "--focal, --baseline, --cx and --cy replace a calibration file"
        raise SettingsError(what, where="--calib", got=calibration, hint="give either")


def camera_of_numbers(
    settings: SourceSettings, size: tuple[int, int], **instead: float
) -> RectifiedCamera:
    """Return the camera of rectified images (width, height) by settings, else ``instead``."""
    numbers = {**instead, **settings.numbers}
    focal_px, baseline_m = numbers.get("focal_px"), numbers.get("baseline_m")
    if focal_px is None or baseline_m is None:
        what = "a rectified camera needs focal length and baseline"
        got = ", ".join(f"{name}={value:g}" for name, value in settings.numbers.items())
        hint = "give both, or --calib FILE"
        raise CalibrationError(what, where="--focal, --baseline", got=got, hint=hint)
    cx_px = numbers.get("cx_px", (size[0] - 1) / 2)
    cy_px = numbers.get("cy_px", (size[1] - 1) / 2)
    camera = RectifiedCamera(focal_px, cx_px, cy_px, cx_px, baseline_m, *size)
    if camera.field_of_view_deg > _WIDEST_DEG:
        raise CalibrationError(
            "focal length is implausible",
            where="--focal",
            got=f"{focal_px:g} px: images of {size[0]} px see {camera.field_of_view_deg:.0f} deg",
            expected=f"at most {_WIDEST_DEG:g} deg",
            hint="it is in pixels, not in millimetres",
        )
    return camera


def find_calibration(folder: Path) -> Path | None:
    """Return the calibration file of a folder, recognised by name; the first in the alphabet."""
    files = sorted(folder.iterdir()) if folder.is_dir() else []
    found = (path for name in _NAMES for path in files if re.fullmatch(name, path.name.lower()))
    return next(found, None)


def as_rectified(rig: Rig) -> Rig:
    """Convert raw cameras that are rectified already, so that no image is resampled for nothing."""
    if isinstance(rig, RectifiedCamera) or not _is_rectified(rig):
        return rig
    left, right = rig.left, rig.right
    size = (left.width_px, left.height_px)
    return RectifiedCamera.from_matrices(left.matrix, right.matrix, rig.baseline_m, *size)


def _is_rectified(rig: StereoCalibration) -> bool:
    """Return whether there is no distortion or rotation, and rows and focal lengths are equal."""
    left, right = rig.left, rig.right
    step_m = rig.T_right_left[:3, 3]
    near = _DIGITS_TOLERANCE
    return bool(
        not left.distortion.any()
        and not right.distortion.any()
        and np.allclose(rig.T_right_left[:3, :3], np.eye(3), rtol=0, atol=near)
        and np.allclose(step_m[1:], 0, rtol=0, atol=near)
        and step_m[0] < 0
        and np.allclose(left.matrix[_ROWS], right.matrix[_ROWS])
        and np.isclose(left.matrix[0, 0], left.matrix[1, 1])
        and (left.width_px, left.height_px) == (right.width_px, right.height_px)
    )
