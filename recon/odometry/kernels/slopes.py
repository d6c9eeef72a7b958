"""Slopes of the surface that a feature is on, by the disparities around it.

The reference implementation in plain numpy is `tests/odometry/kernels/test_slopes.py`.
"""

from __future__ import annotations

from typing import Final, NamedTuple

import numpy as np

from recon.core.kernels.compiled import Float32, Float64, kernel

_RIDGE: Final = 1.0  # squared pixels: neighbours in one line fix no slope across it


class Surface(NamedTuple):
    """What counts as of one surface.

    Attributes:
        radius: Half width of the neighbourhood, pixels.
        step: Every so many rows and columns of it are looked at.
        near: Largest distance of a neighbour from the plane, in disparity.
        least: Neighbours on the plane, with fewer of which it counts as upright.
        rounds: Fits, each to the neighbours that are on the last plane.
    """

    radius: int
    step: int
    near: float
    least: int
    rounds: int


def fit_slopes(values: Float32, uv: Float64, surface: Surface) -> Float64:
    """Fit planes to disparities (H, W) around features (N, 2); NaN = unknown.

    Returns:
        float64 (N, 2), change of the disparity per pixel right and down; 0 where too few are on the
        plane.
    """
    slopes = np.zeros((len(uv), 2))
    radius, step, near, least, rounds = surface
    plain = (radius, step, near, least, rounds)  # numba's cache would remember the class by name
    _fit_all(values, uv, plain, slopes)
    return slopes


@kernel
def _fit_all(
    values: Float32, uv: Float64, surface: tuple[int, int, float, int, int], slopes: Float64
) -> None:
    radius, step, near, least, rounds = surface
    height, width = values.shape
    for n in range(len(uv)):
        column, row = int(np.rint(uv[n, 0])), int(np.rint(uv[n, 1]))
        at = values[min(max(row, 0), height - 1), min(max(column, 0), width - 1)]
        middle, right, down = np.float64(at), 0.0, 0.0
        for _ in range(rounds):
            number, x, y, xx, yy, xy = 0.0, 0.0, 0.0, 0.0, 0.0, 0.0
            d, xd, yd = 0.0, 0.0, 0.0
            for v in range(-radius, radius + 1, step):
                for u in range(-radius, radius + 1, step):
                    if not (0 <= row + v < height and 0 <= column + u < width):
                        continue
                    value = np.float64(values[row + v, column + u])
                    # A comparison with NaN is False.
                    if abs(value - (middle + right * u + down * v)) <= near:
                        number += 1.0
                        x, y, d = x + u, y + v, d + value
                        xx, yy, xy = xx + u * u, yy + v * v, xy + u * v
                        xd, yd = xd + u * value, yd + v * value
            if number < least:
                right, down = 0.0, 0.0
                continue
            a, c = xx + _RIDGE - x * x / number, yy + _RIDGE - y * y / number
            b = xy - x * y / number
            along, across = xd - x * d / number, yd - y * d / number
            determinant = a * c - b * b
            right = (c * along - b * across) / determinant
            down = (a * across - b * along) / determinant
            middle = (d - x * right - y * down) / number
        slopes[n, 0], slopes[n, 1] = right, down
