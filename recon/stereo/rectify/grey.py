"""Conversion of colour images to grey."""

from __future__ import annotations

from typing import Final, Literal

import cv2
import numpy as np

from recon.core.values.arrays import UInt8, frozen_array

GreyMode = Literal["bt601", "mean", "paper"]

_PAPER_WEIGHTS: Final = np.array([0.299, 0.587, 0.144])


def to_grey(image: UInt8, mode: GreyMode = "bt601") -> UInt8:
    """Convert an image, uint8 (H, W, 3) RGB, to grey; a grey image is returned unchanged.

    ``bt601`` weights red, green and blue by 0.299, 0.587 and 0.114, ``mean`` equally. ``paper`` is
    Eq. 6 of the seed paper as printed: its weight of blue, 0.144, is a misprint of 0.114, so the
    weights sum to 1.03 and bright pixels are clipped at 255.

    Ref: ITU-R BT.601, section 2.5.1.
    """
    if isinstance(image, np.ndarray) and image.ndim == 2:
        return frozen_array("image", image, np.uint8, (None, None))
    frozen_array("image", image, np.uint8, (None, None, 3))
    if mode == "bt601":
        return np.asarray(cv2.cvtColor(image, cv2.COLOR_RGB2GRAY))
    if mode == "mean":
        # An integer is never halfway between two multiples of 3, so + 1 rounds to nearest.
        return np.asarray((image.sum(axis=2, dtype=np.uint16) + 1) // 3, dtype=np.uint8)
    return np.asarray(np.clip(np.rint(image @ _PAPER_WEIGHTS), 0, 255), dtype=np.uint8)
