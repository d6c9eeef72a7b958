"""Stripes, tiles and joints, averaged exactly over the footprint of a pixel.

Ref: the box-filtered pulse trains of Peachey, in *Texturing and Modeling*, 3rd ed., ch. 2.
"""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import NDArray

from recon.core.values.arrays import Float64
from recon.street.kernels.noise import lattice_values

_NARROW = 1e-6


def stripe(x: Float64, low: float | Float64, high: float, spread: Float64) -> Float64:
    """Return the fraction (N,) of ``x ± spread / 2`` that lies between ``low`` and ``high``."""
    half = 0.5 * np.maximum(spread, _NARROW)
    inside = np.minimum(x + half, high) - np.maximum(x - half, low)
    return np.asarray(np.maximum(inside, 0.0) / (2.0 * half))


def stripes(x: Float64, period: float, width: float, spread: Float64) -> Float64:
    """Return the fraction (N,) of ``x ± spread / 2`` in stripes ``k·period + [0, width]``."""
    half = 0.5 * np.maximum(spread, _NARROW)

    def covered(t: Float64) -> Float64:
        whole = np.floor(t / period)
        return np.asarray(whole * width + np.minimum(t - whole * period, width))

    return np.asarray((covered(x + half) - covered(x - half)) / (2.0 * half))


def both(a: Float64, b: Float64) -> Float64:
    """Return the fraction covered by at least one of two independent patterns."""
    return np.asarray(1.0 - (1.0 - a) * (1.0 - b))


def tile_tone(
    uv: Float64, tile: tuple[float, float], spread: Float64, seed: NDArray[Any], bond: float = 0.0
) -> Float64:
    """Return a random tone in [-1, 1) per tile, averaged if a pixel covers several.

    ``seed`` is the number of the object; ``bond`` the offset of each row from the one below, as a
    fraction of the tile (bricks: 0.5).
    """
    total = np.zeros(len(uv))
    for su, sv in ((-0.25, -0.25), (-0.25, 0.25), (0.25, -0.25), (0.25, 0.25)):
        row = np.floor((uv[:, 1] + sv * spread[:, 1]) / tile[1])
        column = np.floor((uv[:, 0] + su * spread[:, 0]) / tile[0] + bond * (row % 2))
        total += lattice_values(column, row, seed, 7)
    # A pixel that covers n tiles shows their mean, whose deviation is 1/sqrt(n) times that of one
    # tile; four are sampled.
    several = np.maximum(spread[:, 0] / tile[0], 1.0) * np.maximum(spread[:, 1] / tile[1], 1.0)
    return np.asarray(0.25 * total / several)


def tile_joints(
    uv: Float64, tile: tuple[float, float], joint: float, spread: Float64, bond: float = 0.0
) -> Float64:
    """Return the fraction (N,) of the footprint covered by the joints between tiles."""
    rows = stripes(uv[:, 1], tile[1], joint, spread[:, 1])
    shift = bond * tile[0] * (np.floor(uv[:, 1] / tile[1]) % 2)
    return both(rows, stripes(uv[:, 0] + shift, tile[0], joint, spread[:, 0]))
