"""Finds the calibration of a source, and whether its images are already rectified."""

from __future__ import annotations

import re
from pathlib import Path
from typing import Final

import numpy as np

from recon.core.errors import SourceError
from recon.core.values import RectifiedCamera, Rig, StereoCalibration
from recon.io.cameras.calibration import read_calibration
from recon.sources.settings import SourceSettings

_NAME: Final = re.compile(
    r"(calib|calibration|stereo|cam_?chain|intrinsics|cameras?)([._-].*)?\.(txt|ya?ml|xml|json)"
)
# Focal lengths, skew and principal row: all of a camera matrix but the principal column.
_ROWS: Final = ([0, 0, 1, 1], [0, 1, 1, 2])
# Largest deviation from a rectified pair, given the digits that files print.
_DIGITS_TOLERANCE: Final = 1e-9


def read_rig(
    settings: SourceSettings,
    folder: Path,
    size: tuple[int, int],
    cameras: tuple[int, int] | None = None,
) -> tuple[Rig, tuple[Path, ...]]:
    """Read the calibration named in the settings, else the one in a folder.

    Args:
        settings: May name a file.
        folder: The folder to search otherwise.
        size: Image width and height.
        cameras: Left and right camera of a KITTI file; None = grey if it has that pair.

    Returns:
        The calibration, and the files it was read from.

    Raises:
        SourceError: No file is named and none is found.
        FormatError: The file is damaged.
        CalibrationError: The calibration cannot give depth, or is of another image size.
    """
    path = find_calibration(folder) if settings.calibration is None else Path(settings.calibration)
    if path is None:
        raise SourceError(
            "calibration is missing",
            where=folder,
            expected="calib.txt, calibration.yaml, … in the folder",
            hint="name one with --calib FILE",
        )
    rig = read_calibration(path, *size, metres_per_unit=settings.metres_per_unit, cameras=cameras)
    return as_rectified(rig), (path,)


def find_calibration(folder: Path) -> Path | None:
    """Return the calibration file of a folder, recognised by name; the first in the alphabet."""
    if not folder.is_dir():
        return None
    found = [path for path in folder.iterdir() if _NAME.fullmatch(path.name.lower())]
    return min(found, default=None)


def as_rectified(rig: Rig) -> Rig:
    """Convert two raw cameras that are already rectified; return any other rig unchanged.

    Rectifying such a pair again would resample every image for nothing.
    """
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
