"""Where the calibration of a source comes from, and whether its pictures are rectified already."""

from __future__ import annotations

import re
from pathlib import Path
from typing import Final

import numpy as np

from recon.errors import SourceError
from recon.formats.calibration import read_calibration
from recon.sources.settings import SourceSettings
from recon.structures import RectifiedCamera, StereoCalibration

Rig = RectifiedCamera | StereoCalibration

_NAME: Final = re.compile(
    r"(calib|calibration|stereo|cam_?chain|intrinsics|cameras?)([._-].*)?\.(txt|ya?ml|xml|json)"
)
# Focal lengths, skew and principal row: all of a camera matrix but the principal column.
_ROWS: Final = ([0, 0, 1, 1], [0, 1, 1, 2])
# What a rotation of a rectified pair may be off: the digits that files print.
_DIGITS_TOLERANCE: Final = 1e-9


def read_rig(
    settings: SourceSettings, folder: Path, size: tuple[int, int]
) -> tuple[Rig, tuple[Path, ...]]:
    """Read the calibration that the settings name, else the one that lies in a folder.

    Args:
        settings: Perhaps name a file.
        folder: Where to look otherwise.
        size: Width and height of the pictures, for files that do not tell.

    Returns:
        The calibration, and the files it was read from.

    Raises:
        SourceError: None is named, and none found.
        FormatError: It is damaged.
        CalibrationError: It cannot give depth.
    """
    path = find_calibration(folder) if settings.calibration is None else Path(settings.calibration)
    if path is None:
        raise SourceError(
            "calibration is missing",
            where=folder,
            expected="calib.txt, calibration.yaml, … in the folder",
            hint="name one with --calib FILE",
        )
    rig = read_calibration(path, *size, metres_per_unit=settings.metres_per_unit)
    return as_rectified(rig), (path,)


def find_calibration(folder: Path) -> Path | None:
    """The calibration file of a folder, by its name; the first in the alphabet of several."""
    if not folder.is_dir():
        return None
    found = [path for path in folder.iterdir() if _NAME.fullmatch(path.name.lower())]
    return min(found, default=None)


def as_rectified(rig: Rig) -> Rig:
    """The rectified camera that two raw ones make which need no rectification; else what it was.

    Rectifying such a pair once more would resample every picture for nothing.
    """
    if isinstance(rig, RectifiedCamera) or not _is_rectified(rig):
        return rig
    left, right = rig.left, rig.right
    return RectifiedCamera(
        focal_px=float(left.matrix[0, 0]),
        cx_px=float(left.matrix[0, 2]),
        cy_px=float(left.matrix[1, 2]),
        cx_right_px=float(right.matrix[0, 2]),
        baseline_m=rig.baseline_m,
        width_px=left.width_px,
        height_px=left.height_px,
    )


def _is_rectified(rig: StereoCalibration) -> bool:
    """No distortion, no rotation, no step but to the right, and one focal length and row."""
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
