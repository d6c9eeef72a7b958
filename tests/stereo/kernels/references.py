"""The searches in plain numpy: slow, short, and the definition of their results."""

from __future__ import annotations

import numpy as np
from hypothesis import strategies as st
from hypothesis.extra import numpy as hnp

from recon.core.kernels.compiled import Bool, Float32, Int64, UInt8, UInt16
from recon.stereo.kernels.half_windows import Search
from recon.stereo.kernels.minima import NO_COST, Minima
from recon.stereo.kernels.path_costs import Views, Window
from recon.stereo.kernels.paths import Paths
from recon.stereo.kernels.plane_minima import PARTS, Band
from recon.stereo.kernels.tiles import GROUP, Support, Tiles


@st.composite
def pairs(draw: st.DrawFn, rows: tuple[int, int], columns: tuple[int, int]) -> tuple[UInt8, UInt8]:
    shape = draw(st.tuples(st.integers(*rows), st.integers(*columns)))
    # Few grey levels make ties, many make overflows.
    grey = hnp.arrays(np.uint8, shape, elements=st.integers(0, draw(st.sampled_from([1, 3, 255]))))
    return draw(grey), draw(grey)


def assert_equal(found: Minima, expected: Minima) -> None:
    for name in Minima._fields:
        np.testing.assert_array_equal(getattr(found, name), getattr(expected, name), name)


def sad_minima_reference(left: UInt8, right: UInt8, search: Search, tiles: Tiles) -> Minima:
    """Return all rows of `sad_minima`, from images (H, W)."""
    upright = window_costs_reference(left, right, search._replace(slant=0))
    slanted = window_costs_reference(left, right, search)
    lowest = np.minimum(upright, slanted)
    offered = offered_reference(tiles, left.shape, search.ndisp)
    minima = minima_reference(np.where(offered, lowest, NO_COST), search.minimum)
    k = np.minimum(minima.winner, search.ndisp - 1).astype(np.int64)[:, :, None]
    own = np.where(np.take_along_axis(slanted < upright, k, axis=2), slanted, upright)
    for n, step in ((1, -1), (2, 1)):
        there = np.clip(k + step, 0, search.ndisp - 1)
        cost = np.take_along_axis(own, there, axis=2)[:, :, 0]
        minima.costs[n] = np.where(minima.costs[n] == NO_COST, NO_COST, cost)
    return minima._replace(right_winner=right_winners_reference(minima, search))


def window_costs_reference(left: UInt8, right: UInt8, search: Search) -> Int64:
    """int64 (H, W, ndisp), the cost of each candidate, as if both images went on for ever."""
    height, width = left.shape
    costs = np.zeros((height, width, search.ndisp), np.int64)
    candidates = search.minimum + np.arange(search.ndisp)
    y, x = np.arange(height), np.arange(width)
    reach = search.rows_radius
    upper = [(dy, -search.slant) for dy in range(-reach, 1)]
    lower = [(dy, search.slant) for dy in range(reach + 1)]
    for dy, slant in upper + lower:
        rows = np.clip(y + dy, 0, height - 1)[:, None]
        for dx in range(-search.radius, search.radius + 1):
            columns = np.clip(x + dx, 0, width - 1)
            others = np.clip(x[:, None] + dx - candidates - slant, 0, width - 1)
            a = np.expand_dims(left[rows, columns].astype(np.int64), 2)
            b = right[np.expand_dims(rows, 2), others[None]].astype(np.int64)
            costs += np.minimum(np.abs(a - b), search.cost_cap)
    return costs


def right_winners_reference(minima: Minima, search: Search) -> UInt16:
    """uint16 (H, W), the candidate of the left pixel that chose each right pixel at least cost."""
    chosen = np.full_like(minima.winner, search.ndisp)
    x_last_first = -np.arange(chosen.shape[1])
    for y, costs in enumerate(minima.costs[0].astype(np.int64)):
        # The last one written stands: that of the least cost, and of equal ones the leftmost.
        for x in np.lexsort((x_last_first, -costs)):
            k = int(minima.winner[y, x])
            if k < search.ndisp:
                chosen[y, x - search.minimum - k] = k
    return chosen


def minima_reference(costs: Int64, minimum: int) -> Minima:
    """Return the minima of costs (H, W, ndisp) in both views; `NO_COST` = not offered."""
    width, ndisp = costs.shape[1:]
    k = np.arange(ndisp)
    x = np.arange(width)[:, None]
    inside = (x - minimum - k >= 0) & (x - minimum - k < width) & (costs < NO_COST)
    open_costs = np.where(inside, costs, NO_COST)
    winner = np.where(inside.any(axis=2), open_costs.argmin(axis=2), ndisp)
    after = np.where(winner < ndisp, winner + 1, ndisp)
    beside = [_cost_at(open_costs, place) for place in (winner, winner - 1, after)]
    second = np.where(np.abs(k - winner[:, :, None]) < 2, NO_COST, open_costs).min(axis=2)
    picked = np.stack([*beside, second])
    # Column x_right of the right view sees left column x_right + minimum + k as candidate k.
    seen = x + minimum + k
    clipped = np.clip(seen, 0, width - 1)
    right_costs = np.where(seen == clipped, costs[:, clipped, k], NO_COST)
    right = np.where((seen == clipped).any(axis=1), right_costs.argmin(axis=2), ndisp)
    return Minima(winner.astype(np.uint16), picked.astype(np.uint16), right.astype(np.uint16))


def _cost_at(costs: Int64, k: Int64) -> Int64:
    """Return costs (H, W) of one candidate of each pixel; `NO_COST` outside the range."""
    ndisp = costs.shape[2]
    there = np.clip(k, 0, ndisp - 1)[:, :, None]
    cost = np.take_along_axis(costs, there, axis=2)[:, :, 0]
    return np.where((k >= 0) & (k < ndisp), cost, NO_COST)


def semi_global_minima_reference(
    views: Views, window: Window, paths: Paths, bands: list[Band] | None = None
) -> Minima:
    """Return all rows of `semi_global_minima`, as one block, in columns divided into bands."""
    costs, width = path_costs_reference(views, window, paths.ndisp), views.grey.shape[1]
    parts = [
        _path_means(views.grey[:, start:end], costs[:, start:end], paths)[
            :, first - start : last - start
        ]
        for start, end, first, last in bands or [Band(0, width, 0, width)]
    ]
    return minima_reference(PARTS * np.concatenate(parts, axis=1), paths.minimum)


def _path_means(grey: UInt8, costs: Int64, paths: Paths) -> Int64:
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


def path_reference(grey: UInt8, costs: Int64, paths: Paths, dy: int, dx: int) -> Int64:
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


def offer_supported_reference(
    halved: Float32, minimum: int, ndisp: int, support: Support, tiles: Tiles
) -> Bool:
    """Return what `offer_supported` writes to ``offered``."""
    y = 2 * np.arange(halved.shape[0])[:, None]
    x = 2 * np.arange(halved.shape[1])[None, :]
    k = np.clip(np.rint(2 * halved) - minimum, 0, ndisp - 1)
    offered = np.zeros_like(tiles.offered)
    for i, j, group in np.ndindex(*offered.shape):
        top, left = i * tiles.height - support.margin_y, j * tiles.width - support.margin_x
        bottom = (i + 1) * tiles.height + support.margin_y
        right = (j + 1) * tiles.width + support.margin_x
        seen = (y // 2 >= top // 2) & (y // 2 < bottom // 2)
        seen = seen & (x // 2 >= left // 2) & (x // 2 < right // 2)
        matched = np.count_nonzero(seen & np.isfinite(halved))
        near = (k >= group * GROUP - support.margin) & (k < (group + 1) * GROUP + support.margin)
        enough = np.count_nonzero(seen & near) >= max(support.share * matched, support.least)
        offered[i, j, group] = enough or matched < support.matched * np.count_nonzero(seen)
    return offered


def offered_reference(tiles: Tiles, shape: tuple[int, int], ndisp: int) -> Bool:
    """Return bool (H, W, ndisp), which candidates are offered to which pixel."""
    y, x = np.arange(shape[0]) // tiles.height, np.arange(shape[1]) // tiles.width
    return tiles.offered[y[:, None, None], x[:, None], np.arange(ndisp) // GROUP]
