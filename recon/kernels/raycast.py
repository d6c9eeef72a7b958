"""Evidence of occupancy along rays, in blocks of 8×8×8 voxels that exist where rays went.

A ray is walked cell by cell (Amanatides and Woo 1987). What one frame says of a cell is
collected first, so that a thousand rays through it count once, and a hit outweighs every miss:
OctoMap's rule (Hornung et al. 2013). Then the frame is added to the log-odds.

A measurement is not a point but a normal distribution along its ray: a cell is hit by the share
of the distribution that lies in it, and only what lies well before it is free.

All lengths are in cells. The twins in plain Python stand in `recon.kernels.raycast_reference`.

Ref: J. Amanatides and A. Woo, "A fast voxel traversal algorithm for ray tracing", Eurographics
1987; A. Hornung et al., "OctoMap: an efficient probabilistic 3D mapping framework based on
octrees", Autonomous Robots 34, 2013.
"""

from __future__ import annotations

import math
from typing import Final, NamedTuple

import numpy as np
from numba import njit
from numpy.typing import NDArray

from recon.kernels.voxels import VoxelTable, copy_rows, find_or_add, pack_key

BLOCK_BITS: Final = 3
BLOCK_EDGE: Final = 1 << BLOCK_BITS
BLOCK_CELLS: Final = BLOCK_EDGE**3
_LOW: Final = BLOCK_EDGE - 1
_SQRT2: Final = math.sqrt(2.0)


class Blocks(NamedTuple):
    """The map: one row per block of cells.

    Attributes:
        keys: int64 (B,), packed index of each block.
        log_odds: float32 (B, 512), natural logarithm; NaN = never observed. Cell (i, j, k) of a
            block is column ``(i·8 + j)·8 + k``.
        slots: int32 (B,), row of the block in the evidence of this frame; -1 = not touched.
        used: int64 (1,), number of rows in use.
    """

    keys: NDArray[np.int64]
    log_odds: NDArray[np.float32]
    slots: NDArray[np.int32]
    used: NDArray[np.int64]


class Evidence(NamedTuple):
    """What one frame says: one row per block that it touches.

    Attributes:
        rows: int32 (E,), row in the map of each block touched.
        values: float32 (E, 512), change of the log-odds; 0 = the cell is not touched.
        used: int64 (1,), number of rows in use.
    """

    rows: NDArray[np.int32]
    values: NDArray[np.float32]
    used: NDArray[np.int64]


class Rays(NamedTuple):
    """Rays from one origin; lengths in cells.

    Attributes:
        origin: float64 (3,).
        ends: float64 (N, 3), the measured points.
        free: float64 (N,), length before which every cell is free.
        sigma: float64 (N,), standard deviation of the measured length; 0 = exact.
        hit: float32 (N,), log-odds of a certain hit; 0 = the ray ends in nothing.
        miss: float32 (N,), log-odds of a miss, not above 0.
    """

    origin: NDArray[np.float64]
    ends: NDArray[np.float64]
    free: NDArray[np.float64]
    sigma: NDArray[np.float64]
    hit: NDArray[np.float32]
    miss: NDArray[np.float32]


def make_blocks(rows: int) -> Blocks:
    """An empty map with room for ``rows`` blocks."""
    return Blocks(
        keys=np.zeros(rows, np.int64),
        log_odds=np.full((rows, BLOCK_CELLS), np.nan, np.float32),
        slots=np.full(rows, -1, np.int32),
        used=np.zeros(1, np.int64),
    )


def make_evidence(rows: int) -> Evidence:
    """Evidence of a frame that touches at most ``rows`` blocks."""
    values = np.zeros((rows, BLOCK_CELLS), np.float32)
    return Evidence(np.zeros(rows, np.int32), values, np.zeros(1, np.int64))


def reserve_blocks(blocks: Blocks, rows: int) -> Blocks:
    """A map with room for ``rows`` blocks: the same, or one of twice the size (or more)."""
    have, used = len(blocks.keys), int(blocks.used[0])
    if rows <= have:
        return blocks
    larger = make_blocks(max(rows, 2 * have))
    larger.used[0] = used
    copy_rows(blocks[:-1], larger[:-1], used)
    return larger


def reserve_evidence(evidence: Evidence, rows: int) -> Evidence:
    """Evidence with room for ``rows`` blocks: the same, or one of twice the size (or more)."""
    have, used = len(evidence.rows), int(evidence.used[0])
    if rows <= have:
        return evidence
    larger = make_evidence(max(rows, 2 * have))
    larger.used[0] = used
    copy_rows(evidence[:-1], larger[:-1], used)
    return larger


@njit(cache=True, nogil=True)
def cast_rays(
    table: VoxelTable, blocks: Blocks, evidence: Evidence, rays: Rays, start: int, spread: float
) -> int:
    """Collect the evidence of rays until they end or room runs out.

    The cells that a ray leaves before its length reaches ``free`` are missed. Where it hits,
    the cells that touch ``length ± spread·sigma`` get ``hit`` times the share of the normal
    distribution between the ray's entry and exit. Of several hits the largest counts, of
    several misses the strongest, and a hit outweighs misses; so the order of rays is irrelevant.

    Args:
        table: Hash of the blocks; written.
        blocks: The map; gets new, unobserved blocks.
        evidence: Evidence of this frame; written.
        rays: The rays, all finite; a ray of zero length says nothing.
        start: First ray to cast.
        spread: Half width of the zone of a hit, in standard deviations.

    Returns:
        The first ray that was not cast for want of room in ``table``, ``blocks`` or
        ``evidence``; the number of rays when all were. Casting a ray twice changes nothing.
    """
    for n in range(start, len(rays.ends)):
        if not _cast(table, blocks, evidence, rays, n, spread):
            return n
    return len(rays.ends)


@njit(cache=True, nogil=True)
def _cast(
    table: VoxelTable, blocks: Blocks, evidence: Evidence, rays: Rays, n: int, spread: float
) -> bool:
    """Collect the evidence of ray ``n``; False where room runs out."""
    ox, oy, oz = rays.origin[0], rays.origin[1], rays.origin[2]
    dx, dy, dz = rays.ends[n, 0] - ox, rays.ends[n, 1] - oy, rays.ends[n, 2] - oz
    length = math.sqrt(dx * dx + dy * dy + dz * dz)
    if length == 0:
        return True
    free, sigma, hit, miss = rays.free[n], rays.sigma[n], rays.hit[n], rays.miss[n]
    near = length - spread * sigma if hit > 0 else np.inf
    stop = max(free, length + spread * sigma) if hit > 0 else free

    i, j, k = math.floor(ox), math.floor(oy), math.floor(oz)
    step_x, next_x, delta_x = _axis(ox, dx / length, i)
    step_y, next_y, delta_y = _axis(oy, dy / length, j)
    step_z, next_z, delta_z = _axis(oz, dz / length, k)
    enter, below = 0.0, _normal_cdf(0.0, length, sigma)
    slot, block = -1, -1
    while True:
        leave = min(next_x, next_y, next_z)
        missed = leave <= free
        touched = leave > near
        if missed or touched:
            key = pack_key(i >> BLOCK_BITS, j >> BLOCK_BITS, k >> BLOCK_BITS)
            if key != block:
                slot = _slot(table, blocks, evidence, key)
                if slot < 0:
                    return False
                block = key
            cell = ((i & _LOW) << 6) | ((j & _LOW) << 3) | (k & _LOW)
            value = evidence.values[slot, cell]
            if touched:
                if enter <= near:
                    below = _normal_cdf(enter, length, sigma)
                above = _normal_cdf(leave, length, sigma)
                gain = np.float32(hit * (above - below))
                below = above
                if gain > 0 and gain > value:
                    evidence.values[slot, cell] = gain
            elif value <= 0 and miss < value:
                evidence.values[slot, cell] = miss
        if leave >= stop:
            return True
        enter = leave
        if next_x <= next_y and next_x <= next_z:
            i += step_x
            next_x += delta_x
        elif next_y <= next_z:
            j += step_y
            next_y += delta_y
        else:
            k += step_z
            next_z += delta_z


@njit(cache=True, nogil=True)
def _axis(origin: float, direction: float, cell: int) -> tuple[int, float, float]:
    """Step along one axis, length to the first boundary, length between boundaries."""
    if direction > 0:
        return 1, (cell + 1 - origin) / direction, 1.0 / direction
    if direction < 0:
        return -1, (cell - origin) / direction, -1.0 / direction
    return 0, np.inf, np.inf


@njit(cache=True, nogil=True)
def _normal_cdf(value: float, mean: float, sigma: float) -> float:
    """Share of a normal distribution below ``value``; a step where ``sigma`` is 0."""
    if sigma <= 0:
        return 1.0 if value > mean else 0.0
    return 0.5 * (1.0 + math.erf((value - mean) / (sigma * _SQRT2)))


@njit(cache=True, nogil=True)
def _slot(table: VoxelTable, blocks: Blocks, evidence: Evidence, key: int) -> int:
    """Row of a block in the evidence of this frame, made where it is new; -1 = no room."""
    used, touched = blocks.used[0], evidence.used[0]
    full = used == len(blocks.keys) or 2 * (used + 1) > len(table.keys)
    if full or touched == len(evidence.rows):
        return -1
    row = find_or_add(table, key, used)
    if row == used:
        blocks.keys[row] = key
        blocks.used[0] = used + 1
    if blocks.slots[row] < 0:
        blocks.slots[row] = touched
        evidence.rows[touched] = row
        evidence.used[0] = touched + 1
    return int(blocks.slots[row])


@njit(cache=True, nogil=True)
def apply_evidence(blocks: Blocks, evidence: Evidence, lowest: float, highest: float) -> None:
    """Add a frame's evidence to the map, clamp, and clear the evidence for the next frame."""
    low, high = np.float32(lowest), np.float32(highest)
    for touched in range(evidence.used[0]):
        row = evidence.rows[touched]
        values = evidence.values[touched]
        log_odds = blocks.log_odds[row]
        for cell in range(BLOCK_CELLS):
            change = values[cell]
            if change == 0:
                continue
            before = log_odds[cell]
            after = change if np.isnan(before) else before + change
            log_odds[cell] = min(max(after, low), high)
            values[cell] = 0
        blocks.slots[row] = -1
    evidence.used[0] = 0
