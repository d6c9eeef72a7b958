"""Patches of one image, found again in another that shows them larger, smaller or slanted.

Where a camera drives up to a feature its patch grows, and one on the road slants too. A motion and
a depth say how; with the patch warped accordingly, only its place is left to be found. The slope of
the surface that a feature is on is fitted to the disparities around it.

The reference implementations in plain numpy are in `tests/odometry/kernels/`.
"""

from __future__ import annotations

import math
from typing import Final, NamedTuple

import numpy as np
from numpy.typing import NDArray

from recon.core.kernels.compiled import Float32, Float64, kernel

UInt8 = NDArray[np.uint8]

LEAST_POWER: Final = 1.0
"""Least mean squared deviation of the grey values of a patch from their mean."""

_FLAT: Final = 1e-9
"""Fraction of the squared gradients below which a patch has gradients in one direction alone."""


class Placing(NamedTuple):
    """How patches are placed."""

    radius: int  # half width of a patch, pixels
    steps: int  # Gauss-Newton steps at most
    close: float  # length of a step, pixels, below which it is the last
    reach: float  # largest distance between the guess and the place, pixels, along either axis


def place_patches(
    source: UInt8, target: UInt8, uv: Float64, warp: Float64, guess: Float64, placing: Placing
) -> tuple[Float64, Float64]:
    """Find where patches of one image are in another.

    Brightness and contrast may differ: patches are compared without their mean, at equal power.

    Args:
        source: uint8 (H, W), the image that the patches are cut from.
        target: uint8 (H, W), the image in which they are looked for.
        uv: float64 (N, 2), column and row of their centres in ``source``; NaN = left out.
        warp: float64 (N, 2, 2), what becomes of a small offset from the centre in ``target``.
        guess: float64 (N, 2), where the centres should be; NaN = left out.
        placing: Size of the patches, and how far and how closely they are placed.

    Returns:
        float64 (N, 2), their places, and float64 (N,), the correlation of the two patches there;
        NaN where a patch leaves an image or its reach, or has too little texture.

    Ref:
        Baker and Matthews, "Lucas-Kanade 20 years on", IJCV 2004, section 3.2 (inverse
        compositional).
    """
    place, correlation = np.full((len(uv), 2), np.nan), np.full(len(uv), np.nan)
    radius, steps, close, reach = placing
    plain = (radius, steps, close, reach)  # numba's cache on disk would remember the class by name
    _place_all(source, target, uv, warp, guess, plain, place, correlation)
    return place, correlation


@kernel
def _place_all(
    source: UInt8,
    target: UInt8,
    uv: Float64,
    warp: Float64,
    guess: Float64,
    placing: tuple[int, int, float, float],
    place: Float64,
    correlation: Float64,
) -> None:
    side = 2 * placing[0] + 1
    wide, there = np.empty((side + 2, side + 2)), np.empty((side, side))
    patch, by_u, by_v = np.empty((side, side)), np.empty((side, side)), np.empty((side, side))
    upright = np.eye(2)
    for n in range(len(uv)):
        if not (np.isfinite(uv[n, 0]) and np.isfinite(guess[n, 0])):
            continue
        if not _cut(source, uv[n, 0], uv[n, 1], upright, wide):
            continue
        _differentiate(wide, patch, by_u, by_v)
        _place(
            target, warp[n], guess[n], placing, (patch, by_u, by_v, there), n, place, correlation
        )


@kernel
def _place(
    target: UInt8,
    warp: Float64,
    guess: Float64,
    placing: tuple[int, int, float, float],
    patches: tuple[Float64, Float64, Float64, Float64],
    n: int,
    place: Float64,
    correlation: Float64,
) -> None:
    """Move one patch until it fits; its place stays NaN where it does not."""
    _, steps, close, reach = placing
    patch, by_u, by_v, there = patches
    power, uu, vv, uv = _dot(patch, patch), _dot(by_u, by_u), _dot(by_v, by_v), _dot(by_u, by_v)
    determinant = uu * vv - uv * uv
    if power < LEAST_POWER * patch.size or not determinant > _FLAT * uu * vv:
        return
    u, v, found = guess[0], guess[1], np.nan
    for _ in range(steps):
        if not _cut(target, u, v, warp, there):
            return
        _centre(there)
        gain = math.sqrt(power / max(_dot(there, there), LEAST_POWER))
        found = gain * _dot(there, patch) / power
        right = gain * _dot(by_u, there) - _dot(by_u, patch)
        down = gain * _dot(by_v, there) - _dot(by_v, patch)
        step_u = (vv * right - uv * down) / determinant
        step_v = (uu * down - uv * right) / determinant
        u -= warp[0, 0] * step_u + warp[0, 1] * step_v
        v -= warp[1, 0] * step_u + warp[1, 1] * step_v
        if not (abs(u - guess[0]) <= reach and abs(v - guess[1]) <= reach):
            return
        if step_u * step_u + step_v * step_v < close * close:
            break
    place[n, 0], place[n, 1], correlation[n] = u, v, found


@kernel
def _cut(image: UInt8, u: float, v: float, warp: Float64, patch: Float64) -> bool:
    """Interpolate a warped patch around a place; False where it leaves the image."""
    side, height, width = len(patch), image.shape[0], image.shape[1]
    radius = side // 2
    reach_u = radius * (abs(warp[0, 0]) + abs(warp[0, 1]))
    reach_v = radius * (abs(warp[1, 0]) + abs(warp[1, 1]))
    if not (u - reach_u >= 0 and u + reach_u < width - 1):
        return False
    if not (v - reach_v >= 0 and v + reach_v < height - 1):
        return False
    for i in range(side):
        for j in range(side):
            column = u + warp[0, 0] * (j - radius) + warp[0, 1] * (i - radius)
            row = v + warp[1, 0] * (j - radius) + warp[1, 1] * (i - radius)
            x, y = int(column), int(row)
            right, down = column - x, row - y
            above = image[y, x] * (1.0 - right) + image[y, x + 1] * right
            below = image[y + 1, x] * (1.0 - right) + image[y + 1, x + 1] * right
            patch[i, j] = above * (1.0 - down) + below * down
    return True


@kernel
def _differentiate(wide: Float64, patch: Float64, by_u: Float64, by_v: Float64) -> None:
    """Take a patch and its gradients from one that is a pixel wider, all without their mean."""
    side = len(patch)
    for i in range(side):
        for j in range(side):
            patch[i, j] = wide[i + 1, j + 1]
            by_u[i, j] = 0.5 * (wide[i + 1, j + 2] - wide[i + 1, j])
            by_v[i, j] = 0.5 * (wide[i + 2, j + 1] - wide[i, j + 1])
    _centre(patch)
    _centre(by_u)
    _centre(by_v)


@kernel
def _centre(patch: Float64) -> None:
    total = 0.0
    for value in patch.flat:
        total += value
    mean = total / patch.size
    for i in range(patch.shape[0]):
        for j in range(patch.shape[1]):
            patch[i, j] -= mean


@kernel
def _dot(one: Float64, other: Float64) -> float:
    total = 0.0
    for i in range(one.shape[0]):
        for j in range(one.shape[1]):
            total += one[i, j] * other[i, j]
    return total


_RIDGE: Final = 1.0  # squared pixels: neighbours in one line fix no slope across it


class Surface(NamedTuple):
    """What counts as of one surface."""

    radius: int  # half width of the neighbourhood, pixels
    step: int  # every so many rows and columns of it are looked at
    near: float  # largest distance of a neighbour from the plane, in disparity
    least: int  # neighbours on the plane, with fewer of which it counts as upright
    rounds: int  # fits, each to the neighbours that are on the last plane


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
