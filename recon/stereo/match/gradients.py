"""Horizontal gradients, which windows compare, and their mean magnitude, the texture."""

from __future__ import annotations

from typing import Final

import cv2
import numpy as np
from numpy.typing import NDArray

from recon.core.values import RectifiedPair
from recon.core.values.arrays import Float32, UInt8

_GAIN_OF_SOBEL: Final = 8.0
"""A 3×3 Sobel filter answers a slope of one grey level per pixel with 8."""


def clipped_gradients(image: UInt8, cap: int, rows: range) -> UInt8:
    """Return horizontal gradients of some rows in Sobel units, clipped to plus or minus ``cap``.

    Args:
        image: uint8 (H, W).
        cap: At most 127.
        rows: N consecutive rows.

    Returns:
        uint8 (N, W), ``cap`` where there is none.
    """
    gradients = _sobel(image, rows)
    np.clip(gradients, -cap, cap, out=gradients)
    gradients += cap
    return gradients.astype(np.uint8)


def texture(pair: RectifiedPair, window: tuple[int, int], least: float, rows: range) -> Float32:
    """Return mean size of the horizontal gradient in the window around each pixel of the left view.

    Args:
        pair: The images.
        window: Width and height of the window, pixels.
        least: The threshold; at 0 the texture is not computed, but returned as 0.
        rows: N consecutive rows.

    Returns:
        float32 (N, W) of those rows, grey levels per pixel; NaN = no image.
    """
    width, reach = pair.left.shape[1], window[1] // 2
    mean = np.zeros((len(rows), width), np.float32)
    if least > 0:
        sizes = _sobel(pair.left, _around(rows, reach, len(pair.left)))
        sums = cv2.boxFilter(
            np.abs(sizes, out=sizes).view(np.uint16),
            cv2.CV_32F,
            window,
            normalize=False,
            borderType=cv2.BORDER_REPLICATE,
        )
        above = min(reach, rows.start)
        mean = sums[above : above + len(rows)]
        mean *= np.float32(1 / (_GAIN_OF_SOBEL * window[0] * window[1]))
    if pair.valid is not None:
        mean[~pair.valid[rows.start : rows.stop]] = np.nan
    return np.asarray(mean, dtype=np.float32)


def _around(rows: range, reach: int, height: int) -> range:
    """Return rows, and those around them that the image has."""
    return range(max(rows.start - reach, 0), min(rows.stop + reach, height))


def _sobel(image: UInt8, rows: range) -> NDArray[np.int16]:
    seen = _around(rows, 1, len(image))
    gradient = cv2.Sobel(
        image[seen.start : seen.stop], cv2.CV_16S, 1, 0, borderType=cv2.BORDER_REPLICATE
    )
    above = rows.start - seen.start
    return np.asarray(gradient[above : above + len(rows)], dtype=np.int16)
