"""Horizontal gradients: what windows compare, and how much of it there is in them."""

from __future__ import annotations

from typing import Final

import cv2
import numpy as np
from numpy.typing import NDArray

from recon.structures import RectifiedPair
from recon.structures.arrays import Float32, UInt8

_GAIN_OF_SOBEL: Final = 8.0
"""A 3×3 Sobel filter answers a slope of one grey level per pixel with 8."""


def clipped_gradients(image: UInt8, cap: int) -> UInt8:
    """Horizontal gradients in Sobel units, clipped to plus or minus ``cap``.

    Args:
        image: uint8 (H, W).
        cap: At most 127.

    Returns:
        uint8 (H, W), ``cap`` where there is none.
    """
    gradients = _sobel(image)
    np.clip(gradients, -cap, cap, out=gradients)
    gradients += cap
    return gradients.astype(np.uint8)


def texture(pair: RectifiedPair, window: tuple[int, int], least: float) -> Float32:
    """Mean size of the horizontal gradient in the window around each pixel of the left view.

    Args:
        pair: The pictures.
        window: Width and height of the window, pixels.
        least: What will be asked of it; if that is nothing it is not computed, but 0.

    Returns:
        float32 (H, W), grey levels per pixel; NaN = no picture.
    """
    mean = np.zeros(pair.left.shape, np.float32)
    if least > 0:
        sizes = _sobel(pair.left)
        mean = cv2.boxFilter(
            np.abs(sizes, out=sizes).view(np.uint16),
            cv2.CV_32F,
            window,
            normalize=False,
            borderType=cv2.BORDER_REPLICATE,
        )
        mean *= np.float32(1 / (_GAIN_OF_SOBEL * window[0] * window[1]))
    if pair.valid is not None:
        mean[~pair.valid] = np.nan
    return np.asarray(mean, dtype=np.float32)


def _sobel(image: UInt8) -> NDArray[np.int16]:
    gradient = cv2.Sobel(image, cv2.CV_16S, 1, 0, borderType=cv2.BORDER_REPLICATE)
    return np.asarray(gradient, dtype=np.int16)
