"""Horizontal gradients, which windows compare, and their mean magnitude, the texture."""

from __future__ import annotations

from typing import Final

import cv2
import numpy as np
from numpy.typing import NDArray

from recon.core.values import RectifiedPair
from recon.core.values.arrays import Bool, Float32, UInt8

_GRADIENT_CAP: Final = 31
"""Gradients (Sobel units) are clipped to plus or minus this before windows compare them."""

_GAIN_OF_SOBEL: Final = 8.0
"""A 3×3 Sobel filter answers a slope of one grey level per pixel with 8."""


def clipped_gradients(image: UInt8, rows: range) -> UInt8:
    """Return what windows compare in some rows of an image (H, W): clipped horizontal gradients.

    Returns:
        uint8 (N, W) of N consecutive rows, Sobel units, plus the cap.
    """
    gradients = _sobel(image, rows)
    np.clip(gradients, -_GRADIENT_CAP, _GRADIENT_CAP, out=gradients)
    gradients += _GRADIENT_CAP
    return gradients.astype(np.uint8)


def texture(pair: RectifiedPair, window_px: int, rows: range) -> Float32:
    """Return mean size of the horizontal gradient in the window around each pixel of the left view.

    Args:
        pair: The images.
        window_px: Edge of the square window.
        rows: N consecutive rows.

    Returns:
        float32 (N, W) of those rows, grey levels per pixel; NaN = no image.
    """
    reach = window_px // 2
    sizes = _sobel(pair.left, _around(rows, reach, len(pair.left)))
    sums = cv2.boxFilter(
        np.abs(sizes, out=sizes).view(np.uint16),
        cv2.CV_32F,
        (window_px, window_px),
        normalize=False,
        borderType=cv2.BORDER_REPLICATE,
    )
    above = min(reach, rows.start)
    mean = sums[above : above + len(rows)]
    mean *= np.float32(1 / (_GAIN_OF_SOBEL * window_px * window_px))
    return _where_seen(mean, pair.valid, rows)


def no_texture(width: int, valid: Bool | None, rows: range) -> Float32:
    """Return the same for checks that ask for none: 0, NaN where there is no image."""
    return _where_seen(np.zeros((len(rows), width), np.float32), valid, rows)


def _where_seen(mean: Float32, valid: Bool | None, rows: range) -> Float32:
    if valid is not None:
        mean[~valid[rows.start : rows.stop]] = np.nan
    return mean


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
