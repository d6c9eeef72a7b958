"""Noise of images, and images without the noise that drowns what they show."""

from __future__ import annotations

import math
from typing import Final

import cv2
import numpy as np

from recon.core.values.arrays import UInt8
from recon.stereo.match.search import GRADIENT_CAP

LEAST_NOISE: Final = 0.5  # grey values: rounding alone leaves 0.3
_DROWNING: Final = GRADIENT_CAP / math.sqrt(12.0)
"""Grey values of noise of which a Sobel filter makes gradients as large as any that count."""
_SMOOTH_PX: Final = 1.0  # leaves 0.28 of white noise; more hides corners


def noise_sigma(grey: UInt8) -> float:
    """The standard deviation of the noise of an image, grey values.

    From the median of mixed fourth differences, in which gradients and straight edges cancel.

    Ref: Immerkær, "Fast noise variance estimation", CVIU 1996.
    """
    # Every fourth column and row: some ten thousand values give a median to one per cent.
    columns = [grey[:, k : k + grey.shape[1] - 2 : 4].astype(np.int16) for k in range(3)]
    across = columns[0] - 2 * columns[1] + columns[2]
    rows = [across[k : k + len(across) - 2 : 4] for k in range(3)]
    mixed = rows[0] - 2 * rows[1] + rows[2]
    if not mixed.size:
        return LEAST_NOISE
    # The weights' squares sum to 36; 0.6745 of a normal deviation is its median magnitude.
    return max(float(np.median(np.abs(mixed))) / (6.0 * 0.6745), LEAST_NOISE)


def quieted(left: UInt8, right: UInt8) -> tuple[UInt8, UInt8]:
    """Smooth both images (H, W) where noise hides what they show, as at night."""
    if noise_sigma(left) < _DROWNING or noise_sigma(right) < _DROWNING:
        return left, right
    left, right = (cv2.GaussianBlur(image, (0, 0), _SMOOTH_PX) for image in (left, right))
    return left, right
