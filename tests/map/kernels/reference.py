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
from recon.map.kernels.distance import REACH as REACH_ALONG
from recon.map.kernels.distance import THICKNESS
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


def distance_reference(xyz, normals, farthest):
    """Distance at each corner that is known, as `recon.map.kernels.distance.surface_of` says."""
    around = range(-5, 6)
    near = {
        tuple(np.floor(point).astype(int) + step)
        for point in xyz
        for step in product(around, around, around)
    }
    found = {}
    for corner in near:
        away = np.array(corner) - xyz
        along = (away * normals).sum(axis=1)
        across = away - along[:, None] * normals
        used = (np.abs(along) <= THICKNESS) & ((across**2).sum(axis=1) <= REACH_ALONG**2)
        weight = np.exp(-0.5 * ((across**2).sum(axis=1) + 4 * along**2)) * used
        middle = np.linalg.norm((weight[:, None] * across).sum(axis=0))
        if used.any() and middle <= farthest * weight.sum():
            found[corner] = float((weight * along).sum() / weight.sum())
    return found


def surface_reference(distance):
    """The quads (Q, 4, 3), by their corners, of the surface where the distance is 0, facing up.

    What is on an edge of the grid belongs to the sheet that a walk over the faces of the cell
    reaches from there: over a face, one goes around the corner that is above.
    """
    quads = []
    for corner, axis in product(distance, range(3)):
        end = _stepped(corner, axis, 1)
        if end not in distance or (distance[corner] >= 0) == (distance[end] >= 0):
            continue
        first, second = (axis + 1) % 3, (axis + 2) % 3
        cells = [
            _stepped(_stepped(corner, first, -a), second, -b)
            for a, b in ((0, 0), (1, 0), (1, 1), (0, 1))
        ]
        if all(_eight(cell) <= distance.keys() for cell in cells):
            quad = [_sheet(cell, (corner, end), distance) for cell in cells]
            quads.append(quad if distance[corner] < 0 else quad[::-1])
    return quads


def _stepped(corner, axis, by):
    return tuple(c + by * (a == axis) for a, c in enumerate(corner))


def _eight(cell):
    return {tuple(np.add(cell, step).tolist()) for step in product((0, 1), repeat=3)}


def _sheet(cell, edge, distance):
    """The mean of where the sheet that crosses an edge of a cell crosses all of its edges."""
    reached, to_visit = set(), [edge]
    while to_visit:
        one = to_visit.pop()
        if one in reached:
            continue
        reached.add(one)
        along = int(np.flatnonzero(np.subtract(one[1], one[0]))[0])
        for axis in {0, 1, 2} - {along}:
            side = one[0][axis] - cell[axis]  # of the face across this axis that has the edge
            face = {corner for corner in _eight(cell) if corner[axis] - cell[axis] == side}
            to_visit += _next_on_face(one, face, distance)
    return np.mean([_crossing(one, distance) for one in reached], axis=0)


def _next_on_face(edge, face, distance):
    """The edges of a face that the curve through a crossed edge leaves it by."""
    edges = [
        (a, b)
        for a, b in product(sorted(face), repeat=2)
        if sum(np.subtract(b, a)) == 1 and (distance[a] >= 0) != (distance[b] >= 0)
    ]
    if len(edges) == 4:
        above = max(edge, key=lambda corner: distance[corner])
        edges = [one for one in edges if above in one]
    return edges


def _crossing(edge, distance):
    begin, end = (distance[corner] for corner in edge)
    return np.add(edge[0], begin / (begin - end) * np.subtract(edge[1], edge[0]))


def rays_towards_reference(xyz, cells, edge):
    """Which points lie on rays that may cross cells, as `recon.map.kernels.observations` says."""

    def bins(slopes):
        return np.clip(np.floor((slopes + 1.5) * 128 / 3), 0, 127).astype(int)

    depth = np.maximum(cells[:, 2:], edge)
    slopes = cells[:, :2] / depth
    size = (1 + np.abs(slopes)) * edge * math.sqrt(3) / 2 / depth
    wanted = np.zeros((128, 128), bool)
    for (left, top), (right, bottom) in zip(bins(slopes - size), bins(slopes + size), strict=True):
        wanted[left : right + 1, top : bottom + 1] = True
    ahead = xyz[:, 2] > 0
    column, row = bins(xyz[:, :2] / np.where(ahead, xyz[:, 2], 1)[:, None]).T
    return ahead & wanted[column, row]


def counts_reference(looks, pairs):
    """Counts of frames over looks (F, N): of each cell, and of each pair."""
    cells, of_pairs = np.zeros((3, looks.shape[1]), int), np.zeros((2, len(pairs)), int)
    for n, seen in enumerate(looks.T):
        told = seen[seen != 0]
        begun = np.diff(told, prepend=-1) > 0
        cells[:, n] = (seen > 0).sum(), (seen < 0).sum(), begun.sum()
    for p, (one, other) in enumerate(looks[:, pairs].transpose(1, 2, 0)):
        of_pairs[:, p] = (one * other != 0).sum(), (one * other < 0).sum()
    return cells, of_pairs
