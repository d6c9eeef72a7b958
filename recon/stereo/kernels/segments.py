"""Planes of whole segments: of each the one that most of what was seen in it lies on.

Ref: M. Fischler and R. Bolles, "Random sample consensus", CACM 24, 1981; H. Tao, H. Sawhney,
R. Kumar, "A global matching framework for stereo computation", ICCV 2001 (planes of segments).
"""

from __future__ import annotations

from typing import Final

import numpy as np

from recon.core.kernels.compiled import Float32, Float64, Int32, Int64, kernel
from recon.stereo.kernels.planes import STEEPEST, least_squares

_MOST: Final = 4096  # pixels of a segment that are fitted to, evenly spread
_JUDGES: Final = 512  # of them, those by which a plane through three is judged
_LEAST: Final = 30  # pixels that must lie on a plane
_LEAST_AREA: Final = 200.0  # of the parallelogram of three pixels
_FITS: Final = 3  # each to the pixels that are near the one before


@kernel
def sort_by_label(labels: Int32, starts: Int64, order: Int64) -> None:
    """Write the pixels (N,) of each label (N,), one label after the other, in their order.

    ``starts``, int64 (L + 1,), is where those of each label begin.
    """
    place = starts.copy()
    for pixel in range(labels.size):
        label = labels[pixel]
        order[place[label]] = pixel
        place[label] += 1


@kernel
def fit_segments(
    values: Float32,
    weights: Float32,
    order: Int64,
    starts: Int64,
    wanted: Int64,
    draws: Float64,
    within_px: float,
    first: int,
    end: int,
    planes: Float32,
    ratios: Float32,
) -> None:
    """Give the pixels of some of the segments ``wanted`` their plane, float32 (3, H, W).

    ``shares``, float32 (H, W), gets which fraction of all pixels of the segment lie on it.

    ``values`` and ``weights`` are float32 (H, W), NaN = unknown; pixels that are farther than
    ``within_px`` from a plane do not count. ``draws``, float64 (T, 3), from 0 to 1, says through
    which pixels of a segment planes are tried. Pixels of a segment without a plane keep what they
    have. ``order`` and ``starts`` are as in `sort_by_label`.
    """
    width = values.shape[1]
    points = np.empty((4, _MOST))  # columns, rows, values, weights
    for number in range(first, end):
        begin, stop = starts[wanted[number]], starts[wanted[number] + 1]
        known = 0
        for i in range(begin, stop):
            known += not np.isnan(values[order[i] // width, order[i] % width])
        stride, count, seen = 1 + known // _MOST, 0, 0
        for i in range(begin, stop):
            y, x = order[i] // width, order[i] % width
            if np.isnan(values[y, x]):
                continue
            if seen % stride == 0:
                points[0, count], points[1, count] = x, y
                points[2, count], points[3, count] = values[y, x], weights[y, x]
                count += 1
            seen += 1
        if count < _LEAST:
            continue
        plane, left = _best_plane(points[:, :count], draws, within_px), count
        for _ in range(_FITS):
            if left >= _LEAST:
                left, plane = _refined(points[:, :count], plane, within_px)
        value, across, down = plane
        if left < _LEAST or max(abs(across), abs(down)) > STEEPEST:
            continue
        ratio = np.float32(known * left / (count * (stop - begin)))
        for i in range(begin, stop):
            y, x = order[i] // width, order[i] % width
            planes[0, y, x] = value + across * x + down * y
            planes[1, y, x], planes[2, y, x] = across, down
            ratios[y, x] = ratio


@kernel
def _best_plane(points: Float64, draws: Float64, within_px: float) -> tuple[float, float, float]:
    """Return the plane through three of the points (4, N) that most of them support."""
    x, y, d, w = points
    count = x.size
    stride = 1 + count // _JUDGES
    best, value, across, down = 0.0, d[0], 0.0, 0.0
    for t in range(draws.shape[0]):
        i, j, k = int(draws[t, 0] * count), int(draws[t, 1] * count), int(draws[t, 2] * count)
        jx, jy, jd = x[j] - x[i], y[j] - y[i], d[j] - d[i]
        kx, ky, kd = x[k] - x[i], y[k] - y[i], d[k] - d[i]
        area = jx * ky - jy * kx
        if abs(area) < _LEAST_AREA:
            continue
        a, b = (jd * ky - kd * jy) / area, (jx * kd - kx * jd) / area
        if max(abs(a), abs(b)) > STEEPEST:
            continue
        v, support = d[i] - a * x[i] - b * y[i], 0.0
        for n in range(0, count, stride):
            rest = (d[n] - v - a * x[n] - b * y[n]) / within_px
            support += w[n] * max(0.0, 1.0 - rest * rest)
        if support > best:
            best, value, across, down = support, v, a, b
    return value, across, down


@kernel
def _refined(
    points: Float64, plane: tuple[float, float, float], within_px: float
) -> tuple[int, tuple[float, float, float]]:
    """Return how many of the points (4, N) lie on a plane, and the plane nearest to these."""
    (x, y, d, w), (value, across, down) = points, plane
    # About the middle of the points, for the sake of precision.
    mx, my, near = x.mean(), y.mean(), 0
    n, sx, sy, r, rx, ry, sxx, sxy, syy = 1e-6, 0.0, 0.0, 0.0, 0.0, 0.0, 1e-3, 0.0, 1e-3
    for i in range(x.size):
        rest = d[i] - value - across * x[i] - down * y[i]
        if abs(rest) >= within_px:
            continue
        near += 1
        dx, dy = x[i] - mx, y[i] - my
        n, sx, sy = n + w[i], sx + w[i] * dx, sy + w[i] * dy
        sxx, sxy, syy = sxx + w[i] * dx * dx, sxy + w[i] * dx * dy, syy + w[i] * dy * dy
        r, rx, ry = r + w[i] * rest, rx + w[i] * rest * dx, ry + w[i] * rest * dy
    more, a, b = least_squares(n, sx, sy, r, rx, ry, sxx, sxy, syy)
    return near, (value + more - a * mx - b * my, across + a, down + b)
