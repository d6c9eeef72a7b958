"""Descriptions of pixels by a small network, at full, half and quarter size.

`scripts/train_features.py` makes the network, and says what it was trained on.
"""

from __future__ import annotations

from concurrent.futures import Executor
from functools import partial
from importlib.resources import files
from typing import Final, TypeAlias

import cv2
import numpy as np

from recon.core.values.arrays import Float32, Int32, UInt8
from recon.stereo.kernels import convolution as kernels
from recon.stereo.match import search as common

_PIXELS: Final = 1 << 19  # described at a time: 130 MB
_SIZES: Final = 1, 2, 4  # divisors
_STEP: Final = _SIZES[-1]
_REACH: Final = 24  # pixels around one that its description depends on, a multiple of `_STEP`
_LAYERS: Final = 5  # of each size, over 3 by 3 pixels
_SCALE: Final = 32.0  # grey levels of one unit
_SLOPE: Final = 0.1  # of a layer, below zero
_WEIGHTS: Final = np.array([0.299, 0.587, 0.114], dtype=np.float32)  # of red, green and blue
# Steps of 16 bits: of a grey level, of a unit between layers (where no image exceeds 45 of them),
# and of a unit of features.
_GREY, _BETWEEN, _LAST = 64.0, 512.0, 1024.0
_LARGEST_SUM: Final = 65_000  # of the sizes of weights: with any features a sum fits into 32 bits


Network: TypeAlias = list[tuple[kernels.Layer, ...]]
"""The layers of each size; the last one gives its part of the features."""


def rows_at_once(width: int) -> int:
    """Return how many rows of an image to describe at a time: as many as memory is meant for."""
    return max(_PIXELS // width // _STEP * _STEP, 2 * _REACH)


class Describer:
    """Describes the pixels of one image; rows may be asked for in any order."""

    def __init__(self, network: Network, image: Float32, level: float) -> None:
        self._network = network
        below, beside = (_REACH + -length % _STEP for length in image.shape)
        whole = cv2.copyMakeBorder(
            (image - np.float32(level)) * np.float32(_GREY),
            *(_REACH, below, _REACH, beside),
            cv2.BORDER_REPLICATE,
        )
        self._images = []
        for size in _SIZES:
            # The square of all layers for the first pixel, or the one before it if it is enlarged.
            start, smaller = _REACH // size - _LAYERS - (size > 1), {"fx": 1 / size, "fy": 1 / size}
            grey = cv2.resize(whole, None, **smaller, interpolation=cv2.INTER_AREA)[start:, start:]
            beyond = kernels.STEP + -grey.shape[1] % kernels.STEP
            grey = cv2.copyMakeBorder(grey, 0, 0, 0, beyond, cv2.BORDER_REPLICATE)
            self._images.append((np.rint(grey).astype(np.int32) & 0xFFFF)[:, None])

    def describe(self, first: int, end: int, pool: Executor, threads: int) -> Int32:
        """Return features of length `UNIT` of rows ``first`` (a multiple of 4) to ``end - 1``.

        int32 (N, C / 2, at least W), each two of int16. What is around them is read as well, so
        they are the same in any pieces.
        """
        bottom, found = end + -end % _STEP, []
        for image, layers, size in zip(self._images, self._network, _SIZES, strict=True):
            rows = (bottom - first) // size + 2 * (size > 1)
            part = image[first // size : first // size + rows + 2 * _LAYERS]
            to = np.empty((rows, layers[-1].bias.size // 2, image.shape[2]), np.int32)
            common.in_strips(pool, threads, partial(_convolve, part, layers, to), rows)
            found.append(to)
        full, half, quarter = found
        common.in_strips(pool, threads, partial(_unite, full, half, quarter), end - first)
        return full[: end - first]


def _convolve(image: Int32, layers: tuple[kernels.Layer, ...], to: Int32, rows: range) -> None:
    kernels.convolve_rows(image, layers, rows.start, rows.stop, to)


def _unite(full: Int32, half: Int32, quarter: Int32, rows: range) -> None:
    kernels.unite(full, half, quarter, rows.start, rows.stop)


def load_network() -> Network:
    """Load the network that comes with the program."""
    with files("recon.stereo.match").joinpath("features.npz").open("rb") as file:
        weights = dict(np.load(file))
    sizes: Network = []
    parts = np.split(weights["f.weight"], len(_SIZES), axis=1)
    for number, (name, size, part) in enumerate(zip("abd", _SIZES, parts, strict=True)):
        layers, steps = [], _GREY * _SCALE / size
        for n in range(_LAYERS):
            kernel, bias = weights[f"{name}.{n}.weight"], weights[f"{name}.{n}.bias"]
            layers.append(_layer(kernel, bias, steps, _BETWEEN, _SLOPE))
            steps = _BETWEEN
        bias = weights["f.bias"] if number == 0 else np.zeros_like(weights["f.bias"])
        sizes.append((*layers, _layer(part, bias, steps, _LAST, 1.0)))
    return sizes


def _layer(
    weights: Float32, bias: Float32, steps: float, steps_after: float, slope: float
) -> kernels.Layer:
    """Return a layer in 16 bits, from weights (O, C, S, S) and the steps of a unit around it."""
    (out, channels), group = weights.shape[:2], kernels.GROUP
    flat = weights.reshape(out, channels, -1)
    if channels % 2:
        flat = np.concatenate([flat, np.zeros_like(flat)], axis=1)
    fine = _LARGEST_SUM / np.abs(flat).sum(axis=(1, 2))
    fine = np.minimum(fine, 32767 / np.abs(flat).max(axis=(1, 2)))
    whole = np.rint(flat * fine[:, None, None]).astype(np.int16)
    groups = whole.reshape(-1, group, flat.shape[1] // 2, 2, flat.shape[2])
    pairs = np.ascontiguousarray(groups.transpose(0, 2, 4, 1, 3)).view(np.int32)
    scale = steps_after / (fine * steps)
    return kernels.Layer(
        weights=pairs.reshape(len(pairs), -1, group),
        scale=scale.astype(np.float32),
        bias=(bias * steps_after).astype(np.float32),
        slope=slope,
    )


def fine_grey(grey: UInt8, rgb: UInt8 | None) -> Float32:
    """Return grey levels (H, W), with those between whole ones where there is colour."""
    if rgb is None:
        return grey.astype(np.float32)
    return np.asarray(rgb @ _WEIGHTS, dtype=np.float32)
