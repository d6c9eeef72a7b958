"""Reading one pair with its calibration and ground truth."""

from __future__ import annotations

from dataclasses import dataclass, replace
from pathlib import Path
from typing import Final

import numpy as np

from recon.core.errors import CalibrationError, FormatError
from recon.core.values import DisparityTruth, Rig, StereoPair
from recon.io.cameras.calibration import read_calibration
from recon.io.cameras.kitti import kitti_cameras_of
from recon.io.images.disparity_png import read_disparity
from recon.io.images.exif import read_focal_length
from recon.io.images.image import MAX_MEGAPIXELS
from recon.io.middlebury.scene import stand_in_camera
from recon.sources.calibration import camera_of_numbers, check_given_once
from recon.sources.one_pair import read_pair
from recon.sources.settings import SourceSettings

UP_TO_SCALE: Final = "no baseline was given: all lengths are in baselines, not in metres"


@dataclass(frozen=True, eq=False)
class PairInput:
    """One pair with its calibration and ground truth.

    Attributes:
        pair: The images.
        calibration: Calibration of the two cameras.
        files: Files that the pair was read from.
        truth: True disparity of the rectified left view, or None.
        notes: What the camera was taken from, where there is no calibration file; for warnings.
        up_to_scale: True if the baseline is unknown and counts as 1 m.
    """

    pair: StereoPair
    calibration: Rig
    files: tuple[Path, ...] = ()
    truth: DisparityTruth | None = None
    notes: tuple[str, ...] = ()
    up_to_scale: bool = False


def read_pair_input(
    left: Path,
    right: Path,
    calibration: Path | None,
    *,
    known: SourceSettings | None = None,
    metres_per_unit: float = 1.0,
    max_megapixels: float = MAX_MEGAPIXELS,
) -> PairInput:
    """Read two images with their calibration.

    Args:
        left: Left image.
        right: Right image.
        calibration: Any file that `read_calibration` understands; None = the pair is rectified.
        known: Numbers of the camera, if depth is wanted without a calibration file; the focal
            length may be that in the EXIF data of the left image, and without a baseline the cloud
            is up to scale. The result has notes on both.
        metres_per_unit: Unit of the translation in an OpenCV file; other formats define theirs.
        max_megapixels: Refuse larger images, in 10⁶ pixels.
    """
    if known is not None:
        check_given_once(calibration, known)
    pair = read_pair(left, right, max_megapixels)
    height_px, width_px = pair.left.shape[:2]
    if calibration is None:
        given = PairInput(pair, stand_in_camera(width_px, height_px), (left, right))
        return given if known is None else _with_camera(given, known)
    rig = read_calibration(
        calibration,
        width_px,
        height_px,
        metres_per_unit=metres_per_unit,
        cameras=kitti_cameras_of(left),
    )
    return PairInput(pair, rig, (left, right, calibration))


def _with_camera(given: PairInput, known: SourceSettings) -> PairInput:
    """Return the pair with a camera from what is known of it, and from EXIF data."""
    height_px, width_px = given.pair.left.shape[:2]
    notes, instead = [], {"baseline_m": 1.0}
    if known.focal_px is None:
        left = given.files[0]
        found = read_focal_length(left, width_px, height_px)
        if found is None:
            raise CalibrationError(
                "focal length is unknown: there is no calibration and no EXIF data",
                where=left,
                hint="--calib FILE, or --focal PX",
            )
        instead["focal_px"] = found.focal_px
        notes.append(f"focal length of {found.focal_px:.0f} px from EXIF ({found.basis})")
    camera = camera_of_numbers(known, (width_px, height_px), **instead)
    up_to_scale = known.baseline_m is None
    if up_to_scale:
        notes.append(f"{UP_TO_SCALE}; --baseline M gives metres")
    return replace(given, calibration=camera, notes=tuple(notes), up_to_scale=up_to_scale)


def with_truth(given: PairInput, path: Path | None) -> PairInput:
    """Return the pair with ground truth from a file, of which every known pixel counts.

    Args:
        given: The pair.
        path: True disparity of the rectified left image, PFM or 16-bit PNG; None = none.
    """
    if path is None:
        return given
    values, shape = read_disparity(path), given.pair.left.shape[:2]
    if values.shape != shape:
        raise FormatError(
            "size of the ground truth differs from the images",
            where=path,
            got=f"{values.shape[1]}x{values.shape[0]}",
            expected=f"{shape[1]}x{shape[0]}",
        )
    truth = DisparityTruth(values, np.isfinite(values))
    return replace(given, truth=truth, files=(*given.files, path))
