"""Image sharpness, independent of content and brightness."""

from __future__ import annotations

import cv2
import numpy as np

from recon.core.values.arrays import UInt8


def measure_sharpness(image: UInt8) -> float:
    """Return the share of the finest detail in all detail of an image, in [0, 1].

    Compares Laplacians at full and at quarter size: blur reduces the first, but not the second.
    Sensor noise is subtracted from both.

    Args:
        image: uint8 (H, W).
    """
    fine = image.astype(np.float32)
    coarse = cv2.resize(fine, None, fx=0.25, fy=0.25, interpolation=cv2.INTER_AREA)
    energies = [_detail(layer) for layer in (fine, coarse)]
    total = sum(energies)
    return float(energies[0] / total) if total > 0 else 0.0


def _detail(image: np.ndarray[tuple[int, ...], np.dtype[np.float32]]) -> float:
    """Return mean of the strongest 5 % of absolute Laplacians, minus twice the median of all."""
    size = np.abs(cv2.Laplacian(image, cv2.CV_32F))
    noise, strong = np.quantile(size, [0.5, 0.95])
    return float(max(0.0, size[size >= strong].mean() - 2.0 * noise))
