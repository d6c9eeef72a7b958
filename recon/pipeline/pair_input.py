"""Reading one pair with its calibration and its truth."""

from __future__ import annotations

from pathlib import Path

import numpy as np

from recon.errors import FormatError
from recon.formats.calibration import read_calibration
from recon.formats.disparity_png import read_disparity_png
from recon.formats.image import read_image
from recon.formats.middlebury import stand_in_camera
from recon.formats.pfm import read_pfm
from recon.pipeline.pair_run import PairInput
from recon.structures import DisparityTruth, StereoPair


def read_pair_input(
    left: Path, right: Path, calibration: Path | None, truth: Path | None = None
) -> PairInput:
    """Read two pictures and what belongs to them.

    Args:
        left: Left picture.
        right: Right picture.
        calibration: Any file that `read_calibration` understands; None = the pair is rectified
            and depth is not wanted.
        truth: True disparity of the rectified left picture, PFM or 16-bit PNG.

    Raises:
        FormatError: A file is missing, damaged or of another size.
        ShapeError: The pictures differ in size.
    """
    pair = StereoPair(read_image(left), read_image(right), name=str(left))
    height_px, width_px = pair.left.shape[:2]
    files = tuple(path for path in (left, right, calibration, truth) if path is not None)
    return PairInput(
        pair=pair,
        calibration=stand_in_camera(width_px, height_px)
        if calibration is None
        else read_calibration(calibration, width_px, height_px),
        files=files,
        truth=None if truth is None else _read_truth(truth, (height_px, width_px)),
    )


def _read_truth(path: Path, shape: tuple[int, int]) -> DisparityTruth:
    """A true disparity without an occlusion mask: every known pixel counts."""
    values = read_pfm(path) if path.suffix.lower() == ".pfm" else read_disparity_png(path)
    if values.shape != shape:
        raise FormatError(
            "truth is not of the size of the pictures",
            where=path,
            got=f"{values.shape[1]}x{values.shape[0]}",
            expected=f"{shape[1]}x{shape[0]}",
        )
    return DisparityTruth(values, np.isfinite(values))
