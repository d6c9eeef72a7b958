"""True disparity of Middlebury scenes, and which pixels both cameras see."""

from __future__ import annotations

from pathlib import Path
from typing import Final

import numpy as np

from recon.core.errors import FormatError
from recon.core.values import DisparityTruth
from recon.core.values.arrays import Bool, Float32
from recon.io.images.disparity_png import read_disparity_png
from recon.io.images.image import read_grey_levels
from recon.io.images.pfm import read_pfm
from recon.io.middlebury.layout import Layout, find_image

_MASKS: Final = ("mask0nocc.png", "mask_nocc_derived.png", "v2eval/nonocc.png", "nonocc.png")
_SEEN_BY_BOTH: Final = 255
_TOLERANCE_PX: Final = 1.0


def read_middlebury_truth(
    folder: Path, layout: Layout, scale: float | None, shape: tuple[int, int]
) -> DisparityTruth | None:
    """Read the ground truth of the left image.

    Pixels count as visible to both cameras according to a mask file; without one, where the left
    and right true disparities agree within a pixel; without a right one, everywhere.

    Args:
        folder: Folder of the scene.
        layout: Its file names.
        scale: Grey levels per pixel of disparity; None = PFM.
        shape: (H, W) of the images.

    Returns:
        The ground truth, or None if the folder has none.

    Raises:
        FormatError: A file is damaged or of another size.
    """
    values = _read_disparity(folder, layout.truth_left, scale, shape)
    if values is None:
        return None
    known = np.isfinite(values)
    mask = _read_mask(folder, shape)
    if mask is not None:
        return DisparityTruth(values, known & mask)
    right = _read_disparity(folder, layout.truth_right, scale, shape)
    if right is None:
        return DisparityTruth(values, known)
    return DisparityTruth(values, known & cross_check(values, right, _TOLERANCE_PX))


def cross_check(left: Float32, right: Float32, tolerance_px: float) -> Bool:
    """Return where the left and the right disparity describe the same point.

    Args:
        left: float32 (H, W), disparity of the left image; NaN = unknown.
        right: float32 (H, W), disparity of the right image, also ``x_left - x_right``.
        tolerance_px: Largest difference.

    Returns:
        bool (H, W) in the left image.
    """
    height, width = left.shape
    columns = np.rint(np.arange(width) - np.nan_to_num(left, nan=2.0 * width)).astype(np.int64)
    inside = (columns >= 0) & (columns < width)
    there = right[np.arange(height)[:, None], np.clip(columns, 0, width - 1)]
    return np.asarray(inside & (np.abs(there - left) <= tolerance_px))


def _read_disparity(
    folder: Path, stem: str, scale: float | None, shape: tuple[int, int]
) -> Float32 | None:
    path = folder / f"{stem}.pfm" if scale is None else find_image(folder, stem)
    if path is None or not path.is_file():
        return None
    values = read_pfm(path) if scale is None else read_disparity_png(path, scale=scale)
    _check_shape(path, values.shape, shape)
    return values


def _read_mask(folder: Path, shape: tuple[int, int]) -> Bool | None:
    path = next((folder / name for name in _MASKS if (folder / name).is_file()), None)
    if path is None:
        return None
    levels = read_grey_levels(path)
    _check_shape(path, levels.shape, shape)
    return np.asarray(levels == _SEEN_BY_BOTH)


def _check_shape(path: Path, got: tuple[int, ...], expected: tuple[int, int]) -> None:
    if got != expected:
        raise FormatError(
            "size differs from the images",
            where=path,
            got=f"{got[1]}x{got[0]}",
            expected=f"{expected[1]}x{expected[0]}",
        )
