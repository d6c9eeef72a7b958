"""`recon.kernels.path_costs` and `semi_global` in plain numpy: the definition of their results."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from recon.kernels.minima import Minima
from recon.kernels.path_costs import Views, Window
from recon.kernels.sad_reference import minima_reference
from recon.kernels.semi_global import Paths

Int64 = NDArray[np.int64]


def semi_global_minima_reference(views: Views, window: Window, paths: Paths) -> Minima:
    """All rows of `recon.kernels.semi_global.semi_global_minima`, as one strip."""
    costs = path_costs_reference(views, window, paths.ndisp)
    steps = [(1, 0), (0, 1), (1, 1), (1, -1)] if paths.diagonal else [(1, 0), (0, 1)]
    down = sum(path_reference(views.grey, costs, paths, dy, dx) for dy, dx in steps)
    up = sum(path_reference(views.grey, costs, paths, -dy, -dx) for dy, dx in steps)
    mean_down = (np.asarray(down) + len(steps) // 2) // len(steps)
    sums = np.asarray(up) + len(steps) * mean_down
    return minima_reference(sums[:, :, : paths.ndisp], paths.minimum)


def path_costs_reference(views: Views, window: Window, ndisp: int) -> Int64:
    """int64 (H, W, P), the cost of each candidate at each pixel; the padding at the top."""
    height, width = views.grey.shape
    candidates = views.right.shape[1] - width + 1
    x, k = np.arange(width)[:, None], np.arange(candidates)
    right = views.right[:, width - 1 - x + k].astype(np.int64)
    pixels = np.minimum(np.abs(views.left[:, :, None] - right), window.gradient_cap)
    differ = views.left_census[:, :, :, None] ^ views.right_census[:, :, width - 1 - x + k]
    pixels = pixels + np.unpackbits(differ[..., None], axis=-1).sum(axis=(0, -1), dtype=np.int64)
    sums = np.zeros(pixels.shape, np.int64)
    rows, columns = np.arange(height)[:, None], np.arange(width)
    for dy in range(-window.rows_radius, window.rows_radius + 1):
        for dx in range(-window.radius, window.radius + 1):
            line, column = np.clip(rows + dy, 0, height - 1), np.clip(columns + dx, 0, width - 1)
            sums += pixels[line, column]
    return np.where(k < ndisp, sums * window.factor >> 16, window.top)


def path_reference(grey: NDArray[np.uint8], costs: Int64, paths: Paths, dy: int, dx: int) -> Int64:
    """int64 (H, W, P), costs of the paths that step by ``(dy, dx)`` to each pixel."""
    height, width, candidates = costs.shape
    closed = np.full(candidates + 2, 255 - paths.small)
    result: Int64 = costs.copy()
    for y in range(height) if dy >= 0 else range(height - 1, -1, -1):
        for x in range(width) if dx >= 0 else range(width - 1, -1, -1):
            if not (0 <= y - dy < height and 0 <= x - dx < width):
                continue
            before = result[y - dy, x - dx]
            closed[1:-1] = before
            edge = abs(int(grey[y, x]) - int(grey[y - dy, x - dx])) > paths.edge
            large = paths.large_at_edge if edge else paths.large
            beside = np.minimum(closed[:-2], closed[2:]) + paths.small
            least = np.minimum(np.minimum(before, beside), before.min() + large)
            result[y, x] = costs[y, x] + least - before.min()
    return result
