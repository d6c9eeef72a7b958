"""Back-projection of disparities to points with normals, in one pass over the rows.

With focal length f, a plane ``n·X = 1`` is ``d + doffs = p·(u - cx) + q·(v - cy) + r`` in the
disparity map, and ``n`` is parallel to ``(p·f, q·f, r)``. So a least-squares plane through the
disparities of a window gives the normal, with its sign, without a search for neighbours. Sums over
a window are made down its columns, then along its rows, by loops that the compiler vectorises.
"""

from __future__ import annotations

from typing import Any, Final, NamedTuple

import numpy as np

from recon.core.kernels.compiled import Bool, Float32, UInt8, kernel

MIN_SPREAD: Final = 1e-6  # known pixels that spread by less lie on a line: they have no plane
_COLUMN_SUMS: Final = 5
_WINDOW_SUMS: Final = 9


class PointRules(NamedTuple):
    """Which pixels become points, and how."""

    focal: float  # focal length, pixels
    cx: float  # column of the principal point
    cy: float  # row of the principal point
    fb: float  # focal length times baseline
    doffs: float  # difference of the principal points, pixels
    nearest: float  # least depth
    farthest: float  # largest depth; may be infinite
    relative_sigma: float  # largest error of a depth, divided by it; may be infinite
    stride: int  # every n-th row and column is used
    radius: int  # half width of the window that gives a normal; 0 = no normals


class Maps(NamedTuple):
    """What is known of each pixel."""

    values: Float32  # (H, W), disparity; NaN = unknown
    confidence: Float32  # (H, W)
    sigma: Float32  # (H, W), standard deviation of the disparity
    colours: UInt8  # (H, W, C), one value or three
    usable: Bool  # (H, W), False = makes no point; (0, 0) = all may


class Points(NamedTuple):
    """Points in row order."""

    xyz: Float32  # (N, 3), camera axes
    normals: Float32  # (N, 3), towards the camera; (0, 3) where none were asked for
    sigma: Float32  # (N,), standard deviation of the depth
    confidence: Float32  # (N,)
    colours: UInt8  # (N, 3)


def make_points(maps: Maps, rules: PointRules) -> Points:
    """Return points of all pixels that the rules let through."""
    step = rules.stride
    capacity = int(np.count_nonzero(np.isfinite(maps.values[::step, ::step])))
    points = Points(
        np.empty((capacity, 3), np.float32),
        np.empty((capacity if rules.radius else 0, 3), np.float32),
        np.empty(capacity, np.float32),
        np.empty(capacity, np.float32),
        np.empty((capacity, 3), np.uint8),
    )
    # Plain tuples: numba's cache on disk would remember the classes by name.
    used = _make_points(tuple(maps), tuple(rules), tuple(points))
    return Points(*(array[:used].copy() for array in points))


@kernel(error_model="numpy")
def _make_points(maps: tuple[Any, ...], rules: tuple[Any, ...], points: tuple[Any, ...]) -> int:
    values, confidence, sigma, colours, usable = maps
    focal, cx, cy, fb, doffs, nearest, farthest, relative_sigma, stride, radius = rules
    xyz, normals, sigma_m, sure, rgb = points
    height, width = values.shape
    known, masked = _with_frame(values, radius)
    columns = np.empty((_COLUMN_SUMS, width + 2 * radius), np.float32)
    sums = np.empty((_WINDOW_SUMS, width), np.float32)
    normal = np.empty((3, width), np.float32)
    used, masks = 0, usable.shape[0] > 0
    for v in range(0, height, stride):
        if radius > 0:
            _sum_columns(known, masked, v, radius, columns)
            _sum_windows(columns, radius, sums)
            _fit_normals(sums, values[v], v, rules, normal)
        for u in range(0, width, stride):
            shifted = np.float64(values[v, u]) + doffs
            # A comparison with NaN is False.
            if not shifted > 0.0:
                continue
            if masks and not usable[v, u]:
                continue
            z = np.float32(fb / shifted)
            error = np.float32(np.float64(z) * np.float64(z) * sigma[v, u] / fb)
            if not (z >= nearest and z <= farthest and error <= relative_sigma * z):
                continue
            xyz[used, 0] = np.float32((np.float32(u) - cx) * z / focal)
            xyz[used, 1] = np.float32((np.float32(v) - cy) * z / focal)
            xyz[used, 2] = z
            sigma_m[used] = error
            sure[used] = confidence[v, u]
            for c in range(3):
                rgb[used, c] = colours[v, u, c % colours.shape[2]]
            if radius > 0:
                for c in range(3):
                    normals[used, c] = normal[c, u]
            used += 1
    return used


@kernel
def _with_frame(values: Float32, radius: int) -> tuple[Float32, Float32]:
    """Return ones where a value is known, and the values with 0 elsewhere, in a frame of zeros."""
    height, width = values.shape
    known = np.zeros((height + 2 * radius, width + 2 * radius), np.float32)
    masked = np.zeros((height + 2 * radius, width + 2 * radius), np.float32)
    for v in range(height):
        for u in range(width):
            if np.isfinite(values[v, u]):
                known[v + radius, u + radius] = 1.0
                masked[v + radius, u + radius] = values[v, u]
    return known, masked


@kernel
def _sum_columns(known: Float32, masked: Float32, v: int, radius: int, columns: Float32) -> None:
    """Sums down the columns around row v: 1, v, v², d, v·d of the known pixels."""
    columns[:] = 0.0
    width = columns.shape[1]
    for k in range(2 * radius + 1):
        at = np.float32(k - radius)
        for u in range(width):
            one, d = known[v + k, u], masked[v + k, u]
            columns[0, u] += one
            columns[1, u] += at * one
            columns[2, u] += at * at * one
            columns[3, u] += d
            columns[4, u] += at * d


@kernel
def _sum_windows(columns: Float32, radius: int, sums: Float32) -> None:
    """Sums over windows: 1, u, v, u², v², u·v, d, u·d, v·d of the known pixels."""
    sums[:] = 0.0
    width = sums.shape[1]
    for k in range(2 * radius + 1):
        at = np.float32(k - radius)
        for u in range(width):
            one, v = columns[0, u + k], columns[1, u + k]
            sums[0, u] += one
            sums[1, u] += at * one
            sums[2, u] += v
            sums[3, u] += at * at * one
            sums[4, u] += columns[2, u + k]
            sums[5, u] += at * v
        for u in range(width):
            d = columns[3, u + k]
            sums[6, u] += d
            sums[7, u] += at * d
            sums[8, u] += columns[4, u + k]


@kernel(error_model="numpy")
def _fit_normals(
    sums: Float32, values: Float32, v: int, rules: tuple[Any, ...], normal: Float32
) -> None:
    focal, cx, cy, doffs = rules[0], rules[1], rules[2], rules[4]
    for u in range(len(values)):
        n = np.float64(sums[0, u])
        su, sv = np.float64(sums[1, u]), np.float64(sums[2, u])
        sd = np.float64(sums[6, u])
        # n² times the covariances; those of places are exact, being sums of small integers.
        uu = n * sums[3, u] - su * su
        vv = n * sums[4, u] - sv * sv
        uv = n * sums[5, u] - su * sv
        ud = n * sums[7, u] - su * sd
        vd = n * sums[8, u] - sv * sd
        determinant = uu * vv - uv * uv
        flat = 1.0 if determinant > MIN_SPREAD * n * n * n * n else 0.0
        inverse = flat / (determinant if flat > 0.0 else 1.0)
        slope_u = (ud * vv - vd * uv) * inverse
        slope_v = (vd * uu - ud * uv) * inverse
        x, y = -slope_u * focal, -slope_v * focal
        z = -(values[u] + doffs - slope_u * (u - cx) - slope_v * (v - cy))
        length = max(np.sqrt(x * x + y * y + z * z), 1e-12)
        normal[0, u] = x / length
        normal[1, u] = y / length
        normal[2, u] = z / length
