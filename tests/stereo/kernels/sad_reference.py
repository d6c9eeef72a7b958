"""`recon.stereo.kernels.sad` in plain numpy: slow, short, and the definition of its results."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from recon.stereo.kernels.half_windows import Search
from recon.stereo.kernels.minima import NO_COST, Minima
from recon.stereo.kernels.tiles import Tiles
from tests.stereo.kernels.tiles_reference import offered_reference


def sad_minima_reference(
    left: NDArray[np.uint8], right: NDArray[np.uint8], search: Search, tiles: Tiles
) -> Minima:
    """Return all rows of `recon.stereo.kernels.sad.sad_minima`, from images (H, W)."""
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


def window_costs_reference(
    left: NDArray[np.uint8], right: NDArray[np.uint8], search: Search
) -> NDArray[np.int64]:
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


def right_winners_reference(minima: Minima, search: Search) -> NDArray[np.uint16]:
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


def minima_reference(costs: NDArray[np.int64], minimum: int) -> Minima:
    """Return the minima of costs (H, W, ndisp) in both views; `NO_COST` = not offered."""
    width, ndisp = costs.shape[1:]
    k = np.arange(ndisp)
    x = np.arange(width)[:, None]
    inside = (x - minimum - k >= 0) & (x - minimum - k < width) & (costs < NO_COST)
    open_costs = np.where(inside, costs, NO_COST)
    winner = np.where(inside.any(axis=2), open_costs.argmin(axis=2), ndisp)
    picked = np.stack(
        [
            _cost_at(open_costs, winner),
            _cost_at(open_costs, winner - 1),
            _cost_at(open_costs, np.where(winner < ndisp, winner + 1, ndisp)),
            np.where(np.abs(k - winner[:, :, None]) < 2, NO_COST, open_costs).min(axis=2),
        ]
    )
    # Column x_right of the right view sees left column x_right + minimum + k as candidate k.
    seen = x + minimum + k
    clipped = np.clip(seen, 0, width - 1)
    right_costs = np.where(seen == clipped, costs[:, clipped, k], NO_COST)
    right = np.where((seen == clipped).any(axis=1), right_costs.argmin(axis=2), ndisp)
    return Minima(winner.astype(np.uint16), picked.astype(np.uint16), right.astype(np.uint16))


def _cost_at(costs: NDArray[np.int64], k: NDArray[np.int64]) -> NDArray[np.int64]:
    """Return costs (H, W) of one candidate of each pixel; `NO_COST` outside the range."""
    ndisp = costs.shape[2]
    there = np.clip(k, 0, ndisp - 1)[:, :, None]
    cost = np.take_along_axis(costs, there, axis=2)[:, :, 0]
    return np.where((k >= 0) & (k < ndisp), cost, NO_COST)
