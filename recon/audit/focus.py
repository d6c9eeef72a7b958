"""How sharp a picture is, whatever it shows and however bright it is."""

from __future__ import annotations

import cv2
import numpy as np

from recon.structures.arrays import UInt8


def measure_sharpness(image: UInt8) -> float:
    """Share of the finest detail in the detail of a picture, in [0, 1].

    Laplacians of the picture, and of the picture at a quarter of its size: what is blurred has
    lost the first, and not the second. The noise of the sensor is taken away from both.

    Args:
        image: uint8 (H, W).
    """
    fine = image.astype(np.float32)
    coarse = cv2.resize(fine, None, fx=0.25, fy=0.25, interpolation=cv2.INTER_AREA)
    energies = [_detail(layer) for layer in (fine, coarse)]
    total = sum(energies)
    return float(energies[0] / total) if total > 0 else 0.0


def _detail(image: np.ndarray[tuple[int, ...], np.dtype[np.float32]]) -> float:
    """Mean size of the strongest twentieth of second differences, less the median of all."""
    size = np.abs(cv2.Laplacian(image, cv2.CV_32F))
    noise, strong = np.quantile(size, [0.5, 0.95])
    return float(max(0.0, size[size >= strong].mean() - 2.0 * noise))
