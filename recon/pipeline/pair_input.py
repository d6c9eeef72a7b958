"""Reading one pair with its calibration and ground truth."""

from __future__ import annotations

from pathlib import Path

import numpy as np

from recon.errors import FormatError
from recon.formats.disparity_png import read_disparity_png
from recon.formats.pfm import read_pfm
from recon.pipeline.pair_run import PairInput
from recon.sources.files import FilesSource
from recon.structures import DisparityTruth
from recon.structures.arrays import Float32


def read_pair_input(
    left: Path,
    right: Path,
    calibration: Path | None,
    truth: Path | None = None,
    *,
    metres_per_unit: float = 1.0,
) -> PairInput:
    """Read two images with their calibration and ground truth.

    Args:
        left: Left image.
        right: Right image.
        calibration: Any file that `read_calibration` understands; None = the pair is rectified
            and depth is not wanted.
        truth: True disparity of the rectified left image, PFM or 16-bit PNG.
        metres_per_unit: Unit of the translation in an OpenCV file; other formats define theirs.

    Raises:
        FormatError: A file is missing, damaged or of the wrong size.
        SourceError: The images differ in size.
    """
    source = FilesSource(left, right, calibration, metres_per_unit=metres_per_unit)
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
