"""Reference implementations of the kernels of the map, with cells in a dictionary."""

import math
from collections import defaultdict
from collections.abc import Iterator
from itertools import product
from typing import Any

import numpy as np
from numpy.typing import NDArray

from recon.core.kernels.voxels import unpack_keys
from recon.map.kernels.clamped import ClampedBlocks, observed_rows
from recon.map.kernels.facets import DOUBLINGS, LEAST, REACH
from recon.map.kernels.raycast import MIN_DEPTH_M, Rays

Cell = tuple[int, int, int]

Array = NDArray[Any]
Clamped = tuple[float, float, float]
"""Sum, low, high: stands for ``x → min(max(x + sum, low), high)``."""


def measure_points_reference(xyz, sigma, confidence, T, max_range, margin):
    """Ends of rays (N, 3) and values (N, 4), as `recon.map.kernels.raycast.measure_points` says."""
    scale = np.linalg.norm(T[0, :3])
    metres = np.linalg.norm(xyz, axis=1)
    spread = scale * sigma * metres / np.maximum(np.abs(xyz[:, 2]), MIN_DEPTH_M)
    near = scale * metres <= max_range
    shrink = np.where(near, 1.0, max_range / np.maximum(scale * metres, max_range))
    ends = T[:3, 3] + shrink[:, None] * (xyz @ T[:3, :3].T)
    free = np.minimum(scale * metres - margin * spread, max_range - 1.0)
    return ends, np.stack([spread, free, confidence, near.astype(float)], axis=1)


def limit_points_reference(xyz, sigma, max_range, beyond, margin):
    """Points (N, 3) and deviations (N,), as `recon.map.kernels.raycast.limit_points` says."""
    length = np.linalg.norm(xyz, axis=1)
    shrink = np.where(length <= max_range, 1.0, beyond / np.maximum(length, 1e-30))
    nearer = np.abs(xyz[:, 2]) * (1.0 - shrink)
    left = sigma if margin == 0 else np.maximum(sigma - nearer / margin, 0.0)
    return xyz * shrink[:, None], np.where(shrink == 1.0, sigma, left)


def walk(origin: list[float], direction: list[float]) -> Iterator[tuple[Cell, float, float]]:
    """The cells along a ray without end: cell, length at its entry, length at its exit."""
    cell = [math.floor(o) for o in origin]
    step = [int(np.sign(d)) for d in direction]
    delta = [1.0 / abs(d) if d else math.inf for d in direction]
    following = [
        (c + (d > 0) - o) / d if d else math.inf
        for c, d, o in zip(cell, direction, origin, strict=True)
    ]
    enter = 0.0
    while True:
        leave = min(following)
        yield (cell[0], cell[1], cell[2]), enter, leave
        enter = leave
        axis = following.index(leave)
        cell[axis] += step[axis]
        following[axis] += delta[axis]


def cast_rays_reference(rays: Rays, spread: float) -> dict[Cell, float]:
    """Evidence of one frame, as `recon.map.kernels.raycast.cast_rays` defines it."""
    evidence: dict[Cell, float] = {}
    for n in range(len(rays.ends)):
        for cell, value in _ray(rays, n, spread):
            before = evidence.get(cell, 0.0)
            if value > 0:
                evidence[cell] = max(before, value)
            elif before <= 0:
                evidence[cell] = min(before, value)
    return {cell: value for cell, value in evidence.items() if value != 0}


def _ray(rays: Rays, n: int, spread: float) -> Iterator[tuple[Cell, float]]:
    """What one ray says of each cell that it crosses."""
    way = rays.ends[n] - rays.origin
    length = math.sqrt(sum(x * x for x in way.tolist()))
    if length == 0:
        return
    free, sigma, hit = float(rays.free[n]), float(rays.sigma[n]), float(rays.hit[n])
    near = length - spread * sigma if hit > 0 else math.inf
    stop = max(free, length + spread * sigma) if hit > 0 else free
    for cell, enter, leave in walk(rays.origin.tolist(), (way / length).tolist()):
        if leave > near:
            yield cell, hit * (_below(leave, length, sigma) - _below(enter, length, sigma))
        elif leave <= free:
            yield cell, float(rays.miss[n])
        if leave >= stop:
            return


def _below(value: float, mean: float, sigma: float) -> float:
    if sigma <= 0:
        return float(value > mean)
    return 0.5 * (1.0 + math.erf((value - mean) / (sigma * math.sqrt(2.0))))


def apply_evidence_reference(log_odds, evidence, lowest, highest):
    """Add a frame's evidence to the log-odds of a map and clamp: what a part stands for."""
    for cell, change in evidence.items():
        log_odds[cell] = min(max(log_odds.get(cell, 0.0) + change, lowest), highest)


def move_reference(cells: dict[Cell, Clamped], T_new_old: Array) -> dict[Cell, Clamped]:
    """Each new cell takes what the old cell at its centre has."""
    centres = np.array(list(cells), dtype=np.float64).reshape(-1, 3) + 0.5
    T_old_new = np.linalg.inv(T_new_old)
    moved: dict[Cell, Clamped] = {}
    for centre in centres @ T_new_old[:3, :3].T + T_new_old[:3, 3]:
        for offset in product((-1, 0, 1), repeat=3):
            new = np.floor(centre).astype(int) + offset
            i, j, k = np.floor(T_old_new[:3, :3] @ (new + 0.5) + T_old_new[:3, 3]).astype(int)
            if (i, j, k) in cells:
                moved[tuple(new.tolist())] = cells[i, j, k]
    return moved


Points = dict[Cell, tuple[float, Array, float]]
"""Sum of weights, mean (3,) in space, and mean variance of each cell that holds points."""


def is_crossed(cell: Cell, points: Points) -> bool:
    """Whether a cell is crossed, as `recon.map.kernels.facets.crossed_cells` defines it."""
    centre, windows = np.array(cell) + 0.5, [points]
    for doublings in range(DOUBLINGS + 1):
        known = _around(centre / 2**doublings, 1, windows[-1])
        weights = np.array([weight for weight, _, _ in known])
        if not known or np.average([v for _, _, v in known], weights=weights) <= 1:
            break
        windows.append(_doubled(windows[-1]))
    finer = max(0, doublings - 1)
    near = _around(centre / 2**finer, REACH if doublings else 1, windows[finer])
    half = 0.5 / 2**finer
    if len(known) < LEAST or not near:
        return any(np.abs(place).max() <= half for _, place, _ in near)
    spread = np.cov(np.array([place for _, place, _ in known]).T, aweights=weights, ddof=0)
    normal = np.linalg.eigh(spread)[1][:, 0]
    weights, places = np.array([w for w, _, _ in near]), np.array([place for _, place, _ in near])
    along = places @ normal
    beside = (places**2).sum(axis=1) - along**2
    distance = np.average(along, weights=weights * np.exp(-beside))
    return bool(abs(distance) <= half * np.abs(normal).sum())


def _around(place: Array, reach: int, points: Points) -> list[tuple[float, Array, float]]:
    home = np.floor(place).astype(int)
    cells = (home + step for step in product(range(-reach, reach + 1), repeat=3))
    found = [points[tuple(cell.tolist())] for cell in cells if tuple(cell.tolist()) in points]
    return [(weight, mean - place, variance) for weight, mean, variance in found]


def _doubled(points: Points) -> Points:
    held: dict[Cell, list[tuple[float, Array, float]]] = defaultdict(list)
    for (i, j, k), (weight, mean, variance) in points.items():
        held[i // 2, j // 2, k // 2].append((weight, mean / 2, variance / 4))
    return {
        cell: (
            sum(weights := [weight for weight, _, _ in several]),
            np.average([mean for _, mean, _ in several], axis=0, weights=weights),
            float(np.average([variance for _, _, variance in several], weights=weights)),
        )
        for cell, several in held.items()
    }


def cells_of(blocks: ClampedBlocks) -> dict[Cell, Clamped]:
    rows = observed_rows(blocks)
    corner = np.repeat(unpack_keys(rows.blocks) * 8, np.diff(rows.starts), axis=0)
    local = np.stack(np.unravel_index(rows.cells, (8, 8, 8)), axis=1)
    keys = (tuple(key) for key in (corner + local).tolist())
    return dict(zip(keys, map(tuple, rows.values.tolist()), strict=True))


def log_odds_of(blocks: ClampedBlocks) -> dict[Cell, float]:
    cells = cells_of(blocks).items()
    return {cell: min(max(change, low), high) for cell, (change, low, high) in cells}
