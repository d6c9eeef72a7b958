"""Brightness ratio of the two cameras."""

from __future__ import annotations

from typing import Final

import cv2
import numpy as np

from recon.core.values.arrays import Float32, Float64, UInt8

# Half of the pixels around a corner may be saturated before their median is.
_AROUND_PX: Final = 9
_DARK: Final = 12.0
_BRIGHT: Final = 243.0


def measure_gain(left: UInt8, right: UInt8, left_uv: Float32, right_uv: Float32) -> Float64:
    """Return the brightness of the right image relative to the left, around matched features.

    Args:
        left: uint8 (H, W).
        right: uint8 (H, W).
        left_uv: float32 (N, 2), features in the left image.
        right_uv: float32 (N, 2), the same features in the right image.

    Returns:
        float64 (M,), one ratio for each feature whose surroundings are mostly neither black
        nor saturated.
    """
    first, second = (_medians(image, uv) for image, uv in ((left, left_uv), (right, right_uv)))
    fair = (np.minimum(first, second) > _DARK) & (np.maximum(first, second) < _BRIGHT)
    return np.asarray(second[fair] / first[fair], dtype=np.float64)


def _medians(image: UInt8, uv: Float32) -> Float64:
    """Return the median brightness around each feature."""
    smooth = cv2.medianBlur(np.ascontiguousarray(image), _AROUND_PX)
    height, width = image.shape
    column = np.clip(np.rint(uv[:, 0]).astype(int), 0, width - 1)
    row = np.clip(np.rint(uv[:, 1]).astype(int), 0, height - 1)
    return np.asarray(smooth[row, column], dtype=np.float64)
