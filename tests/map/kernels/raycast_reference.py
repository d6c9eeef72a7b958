"""The twin of `recon.map.kernels.raycast`: one ray at a time, cells in a dictionary."""

from __future__ import annotations

import math
from collections.abc import Iterator
from typing import Any

import numpy as np
from numpy.typing import NDArray

from recon.map.kernels.raycast import MIN_DEPTH_M, Rays
from tests.core.kernels.voxels_reference import Cell


def measure_points_reference(
    xyz: NDArray[Any],
    sigma: NDArray[Any],
    confidence: NDArray[Any],
    T: NDArray[Any],
    max_range: float,
    margin: float,
) -> tuple[NDArray[Any], NDArray[Any]]:
    """Ends of rays (N, 3) and values (N, 4), as `recon.map.kernels.raycast.measure_points` says."""
    scale = np.linalg.norm(T[0, :3])
    metres = np.linalg.norm(xyz, axis=1)
    spread = scale * sigma * metres / np.maximum(np.abs(xyz[:, 2]), MIN_DEPTH_M)
    near = scale * metres <= max_range
    shrink = np.where(near, 1.0, max_range / np.maximum(scale * metres, max_range))
    ends = T[:3, 3] + shrink[:, None] * (xyz @ T[:3, :3].T)
    free = np.minimum(scale * metres - margin * spread, max_range - 1.0)
    return ends, np.stack([spread, free, confidence, near.astype(float)], axis=1)


def limit_points_reference(
    xyz: NDArray[Any], sigma: NDArray[Any], max_range: float, beyond: float, margin: float
) -> tuple[NDArray[Any], NDArray[Any]]:
    """Points (N, 3) and deviations (N,), as `recon.map.kernels.raycast.limit_points` says."""
    length = np.linalg.norm(xyz, axis=1)
    shrink = np.where(length <= max_range, 1.0, beyond / np.maximum(length, 1e-30))
    nearer = np.abs(xyz[:, 2]) * (1.0 - shrink)
    left = sigma if margin == 0 else np.maximum(sigma - nearer / margin, 0.0)
    return xyz * shrink[:, None], np.where(shrink == 1.0, sigma, left)


def walk_reference(
    origin: tuple[float, float, float], direction: tuple[float, float, float]
) -> Iterator[tuple[Cell, float, float]]:
    """The cells along a ray without end: cell, length at its entry, length at its exit.

    Args:
        origin: Where the ray starts, in cells.
        direction: Unit vector.
    """
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
    x, y, z = (rays.ends[n] - rays.origin).tolist()
    length = math.sqrt(x * x + y * y + z * z)
    if length == 0:
        return
    free, sigma, hit = float(rays.free[n]), float(rays.sigma[n]), float(rays.hit[n])
    near = length - spread * sigma if hit > 0 else math.inf
    stop = max(free, length + spread * sigma) if hit > 0 else free
    ox, oy, oz = rays.origin.tolist()
    for cell, enter, leave in walk_reference((ox, oy, oz), (x / length, y / length, z / length)):
        if leave > near:
            yield cell, hit * (_below(leave, length, sigma) - _below(enter, length, sigma))
        elif leave <= free:
            yield cell, float(rays.miss[n])
        if leave >= stop:
            return


def _below(value: float, mean: float, sigma: float) -> float:
    """Share of a normal distribution below ``value``."""
    if sigma <= 0:
        return float(value > mean)
    return 0.5 * (1.0 + math.erf((value - mean) / (sigma * math.sqrt(2.0))))
