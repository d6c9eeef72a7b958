"""Reading one pair with its calibration and ground truth."""

from __future__ import annotations

from dataclasses import dataclass, replace
from pathlib import Path
from typing import Final

import numpy as np

from recon.commands.pair import PairInput
from recon.core.errors import CalibrationError, FormatError
from recon.core.values import DisparityTruth, RectifiedCamera
from recon.core.values.arrays import Float32
from recon.io.images.disparity_png import read_disparity_png
from recon.io.images.exif import read_focal_length
from recon.io.images.image import MAX_MEGAPIXELS
from recon.io.images.pfm import read_pfm
from recon.io.middlebury.scene import stand_in_camera
from recon.sources.files import FilesSource

UP_TO_SCALE: Final = "no baseline was given: all lengths are in baselines, not in metres"


@dataclass(frozen=True)
class KnownCamera:
    """What is known of the camera of a rectified pair that has no calibration file.

    Attributes:
        focal_px: Focal length; None = that in the EXIF data of the left image.
        baseline_m: Distance between the cameras; None = unknown, the cloud is up to scale.
        cx_px: Column of the principal point of both views; None = the middle.
        cy_px: Its row; None = the middle.
    """

    focal_px: float | None = None
    baseline_m: float | None = None
    cx_px: float | None = None
    cy_px: float | None = None


def read_uncalibrated_pair(
    left: Path,
    right: Path,
    known: KnownCamera,
    truth: Path | None = None,
    *,
    max_megapixels: float = MAX_MEGAPIXELS,
) -> PairInput:
    """Read a rectified pair without a calibration file.

    Args:
        left: Left image.
        right: Right image.
        known: What is known of its camera.
        truth: See `read_pair_input`.
        max_megapixels: See `read_pair_input`.

    Returns:
        The pair, with notes on what its camera was taken from.

    Raises:
        CalibrationError: The focal length is neither given nor in the image, or not positive.
        FormatError: A file is missing, damaged or of the wrong size.
        SourceError: The images differ in size.
    """
    given = read_pair_input(left, right, None, truth, max_megapixels=max_megapixels)
    height_px, width_px = given.pair.left.shape[:2]
    focal_px, basis = known.focal_px, ""
    if focal_px is None:
        found = read_focal_length(left, width_px, height_px)
        if found is None:
            raise CalibrationError(
                "focal length is unknown: there is no calibration and no EXIF data",
                where=left,
                hint="--calib FILE, or --focal PX",
            )
        focal_px = found.focal_px
        basis = f"focal length of {focal_px:.0f} px from EXIF ({found.basis})"
    middle = stand_in_camera(width_px, height_px)
    cx_px = middle.cx_px if known.cx_px is None else known.cx_px
    camera = RectifiedCamera(
        focal_px=focal_px,
        cx_px=cx_px,
        cy_px=middle.cy_px if known.cy_px is None else known.cy_px,
        cx_right_px=cx_px,
        baseline_m=1.0 if known.baseline_m is None else known.baseline_m,
        width_px=width_px,
        height_px=height_px,
    )
    up_to_scale = known.baseline_m is None
    unscaled = f"{UP_TO_SCALE}; --baseline M gives metres" if up_to_scale else ""
    notes = tuple(note for note in (basis, unscaled) if note)
    return replace(given, calibration=camera, notes=notes, up_to_scale=up_to_scale)


def read_pair_input(
    left: Path,
    right: Path,
    calibration: Path | None,
    truth: Path | None = None,
    *,
    metres_per_unit: float = 1.0,
    max_megapixels: float = MAX_MEGAPIXELS,
) -> PairInput:
    """Read two images with their calibration and ground truth.

    Args:
        left: Left image.
        right: Right image.
        calibration: Any file that `read_calibration` understands; None = the pair is rectified
            and depth is not wanted.
        truth: True disparity of the rectified left image, PFM or 16-bit PNG.
        metres_per_unit: Unit of the translation in an OpenCV file; other formats define theirs.
        max_megapixels: Refuse larger images, in 10⁶ pixels.

    Raises:
        FormatError: A file is missing, damaged or of the wrong size.
        SourceError: The images differ in size.
    """
    source = FilesSource(
        left,
        right,
        calibration,
        metres_per_unit=metres_per_unit,
        max_megapixels=max_megapixels,
    )
    (pair,) = source
    return PairInput(
        pair=pair,
        calibration=source.calibration,
        files=source.files if truth is None else (*source.files, truth),
        truth=None if truth is None else _read_truth(truth, pair.left.shape[:2]),
    )


def read_disparity(path: Path) -> Float32:
    """A disparity map, PFM or 16-bit PNG by its suffix: float32 (H, W), NaN = unknown.

    Raises:
        FormatError: The file is missing or damaged.
    """
    return read_pfm(path) if path.suffix.lower() == ".pfm" else read_disparity_png(path)


def _read_truth(path: Path, shape: tuple[int, ...]) -> DisparityTruth:
    """A true disparity without an occlusion mask: every known pixel counts."""
    values = read_disparity(path)
    if values.shape != shape:
        raise FormatError(
            "size of the ground truth differs from the images",
            where=path,
            got=f"{values.shape[1]}x{values.shape[0]}",
            expected=f"{shape[1]}x{shape[0]}",
        )
    return DisparityTruth(values, np.isfinite(values))
