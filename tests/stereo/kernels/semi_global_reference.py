"""`path_costs` and `semi_global` in plain numpy: the definition of their results."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from recon.stereo.kernels.minima import Minima
from recon.stereo.kernels.path_costs import Views, Window
from recon.stereo.kernels.paths import Paths
from recon.stereo.kernels.plane_minima import PARTS, Band
from tests.stereo.kernels.sad_reference import minima_reference

Int64 = NDArray[np.int64]


def semi_global_minima_reference(
    views: Views, window: Window, paths: Paths, bands: list[Band] | None = None
) -> Minima:
    """Return all rows of `recon.stereo.kernels.semi_global.semi_global_minima`, as one block.

    Args:
        views: As there.
        window: As there.
        paths: As there.
        bands: How the columns are divided; None = not at all.
    """
    costs, width = path_costs_reference(views, window, paths.ndisp), views.grey.shape[1]
    parts = [
        _path_means(views.grey[:, start:end], costs[:, start:end], paths)[
            :, first - start : last - start
        ]
        for start, end, first, last in bands or [Band(0, width, 0, width)]
    ]
    return minima_reference(PARTS * np.concatenate(parts, axis=1), paths.minimum)


def _path_means(grey: NDArray[np.uint8], costs: Int64, paths: Paths) -> Int64:
    """Return int64 (H, W, P), mean costs of the paths to each pixel."""

    def along(dy: int, dx: int) -> Int64:
        return path_reference(grey, costs, paths, dy, dx)

    down, up = (_mean(along(dy, 0), _mean(along(dy, 1), along(dy, -1))) for dy in (1, -1))
    return _mean(_mean(along(0, 1), along(0, -1)), _mean(down, up))


def _mean(a: Int64, b: Int64) -> Int64:
    return (a + b + 1) >> 1


def path_costs_reference(views: Views, window: Window, ndisp: int) -> Int64:
    """Return int64 (H, W, P), the cost of each candidate at each pixel."""
    height, width = views.grey.shape
    x, k = np.arange(views.left.shape[2])[:, None], np.arange(ndisp)
    left, right = views.left[..., None], views.right[:, :, x - k + ndisp - 1]
    pixels = np.minimum(abs(left[:, 0].astype(np.int64) - right[:, 0]), window.gradient_cap)
    differ = left[:, 1:] ^ right[:, 1:]
    pixels = pixels + np.unpackbits(differ[..., None], axis=-1).sum(axis=(1, -1), dtype=np.int64)
    across = sum(pixels[:, dx : dx + width] for dx in range(2 * window.radius + 1))
    across = np.asarray(across) >> window.row_shift
    sums, rows = np.zeros(across.shape, np.int64), np.arange(height)
    for dy in range(-window.rows_radius, window.rows_radius + 1):
        sums += across[np.clip(rows + dy, 0, height - 1)]
    return sums * window.factor >> window.shift


def path_reference(grey: NDArray[np.uint8], costs: Int64, paths: Paths, dy: int, dx: int) -> Int64:
    """Return int64 (H, W, P), costs of the paths that step by ``(dy, dx)`` to each pixel."""
    height, width, candidates = costs.shape
    closed = np.full(candidates + 2, 255 - paths.p1)
    result: Int64 = costs.copy()
    for y in range(height) if dy >= 0 else range(height - 1, -1, -1):
        for x in range(width) if dx >= 0 else range(width - 1, -1, -1):
            if not (0 <= y - dy < height and 0 <= x - dx < width):
                continue
            before = result[y - dy, x - dx]
            closed[1:-1] = before
            edge = abs(int(grey[y, x]) - int(grey[y - dy, x - dx])) > paths.edge
            p2 = paths.p2_at_edge if edge else paths.p2
            beside = np.minimum(closed[:-2], closed[2:]) + paths.p1
            least = np.minimum(np.minimum(before, beside), before.min() + p2)
            result[y, x] = costs[y, x] + least - before.min()
    return result
