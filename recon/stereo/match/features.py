"""Descriptions of pixels by a small network, which OpenCV runs on the processor.

`scripts/train_features.py` makes the network, and says what it was trained on.
"""

from __future__ import annotations

from importlib.resources import files
from typing import Any, Final

import cv2
import numpy as np

from recon.core.values.arrays import Float32, UInt8

_PIXELS: Final = 1 << 18  # described at a time: 200 MB
_REACH: Final = 24  # pixels around one that its description depends on, rounded up to `_STEP`
_STEP: Final = 4  # the network halves the image twice
_SCALE: Final = 32.0  # grey levels of one unit
_WEIGHTS: Final = np.array([0.299, 0.587, 0.114], dtype=np.float32)  # of red, green and blue


def rows_at_once(width: int) -> int:
    """Return how many rows of an image to describe at a time: as many as memory is meant for."""
    return max(_PIXELS // width // _STEP * _STEP, 2 * _REACH)


class Describer:
    """Describes the pixels of one image; rows may be asked for in any order."""

    def __init__(self, network: Any, image: Float32, level: float) -> None:
        self._network, self._size = network, image.shape
        below, beside = (_REACH + -length % _STEP for length in image.shape)
        self._image = cv2.copyMakeBorder(
            (image - np.float32(level)) / np.float32(_SCALE),
            *(_REACH, below, _REACH, beside),
            cv2.BORDER_REPLICATE,
        )

    def describe(self, first: int, end: int) -> Float32:
        """Return features of unit length of rows ``first`` (a multiple of 4) to ``end - 1``.

        float32 (N, C, W). What is around them is read as well, so they are the same in any pieces.
        """
        bottom = end + -end % _STEP
        rows = self._image[first : bottom + 2 * _REACH]
        self._network.setInput(rows[None, None])
        found = self._network.forward()[0]
        inner = found[:, _REACH : _REACH + end - first, _REACH : _REACH + self._size[1]]
        features = np.ascontiguousarray(inner.transpose(1, 0, 2))
        features /= np.maximum(np.sqrt(np.einsum("ncw,ncw->nw", features, features)), 1e-6)[:, None]
        return np.asarray(features, dtype=np.float32)


def load_network() -> Any:
    """Load the network that comes with the program."""
    data = files("recon.stereo.match").joinpath("features.onnx").read_bytes()
    return cv2.dnn.readNetFromONNX(np.frombuffer(data, np.uint8))


def fine_grey(grey: UInt8, rgb: UInt8 | None) -> Float32:
    """Return grey levels (H, W), with those between whole ones where there is colour."""
    if rgb is None:
        return grey.astype(np.float32)
    return np.asarray(rgb @ _WEIGHTS, dtype=np.float32)
