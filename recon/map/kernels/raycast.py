"""Evidence of occupancy along rays, in blocks of 8×8×8 voxels that are allocated where rays go.

The evidence of one frame is collected first, so that a thousand rays through a cell count once and
a hit outweighs every miss; then `recon.map.kernels.clamped` adds the frame to the log-odds. A
measurement is a normal distribution along its ray: a cell is hit by the fraction of the
distribution that lies in it, and only what lies well before it is free. All lengths are in cells,
except those of the points given. Reference implementations: `tests/map/kernels/reference.py`.

Ref: J. Amanatides and A. Woo, "A fast voxel traversal algorithm for ray tracing", Eurographics
1987; A. Hornung et al., "OctoMap: an efficient probabilistic 3D mapping framework based on
octrees", Autonomous Robots 34, 2013.
"""

from __future__ import annotations

import math
from typing import Any, Final, NamedTuple

import numpy as np
from numpy.typing import NDArray

from recon.core.kernels.compiled import Float32, Float64, Int64, kernel
from recon.core.kernels.voxels import (
    KEY_BITS,
    enter_keys,
    find,
    find_or_add,
    make_table,
    pack_key,
    reserve,
    unpack_key,
)

BLOCK_BITS: Final = 3
BLOCK_EDGE: Final = 1 << BLOCK_BITS
BLOCK_CELLS: Final = BLOCK_EDGE**3
_LOW: Final = BLOCK_EDGE - 1
_ALONG_X: Final = 1 << (2 * KEY_BITS)
_ALONG_Y: Final = 1 << KEY_BITS
_CORNER: Final = ~(_LOW * (_ALONG_X + _ALONG_Y + 1))
"""The bits of a packed cell that say in which block it is."""
MIN_DEPTH_M: Final = 1e-9
_SQRT2: Final = math.sqrt(2.0)


class Blocks(NamedTuple):
    """The evidence of one frame: blocks of cells, one row each.

    Cell (i, j, k) of a block is column ``(i·8 + j)·8 + k``.
    """

    table: Int64  # (C, 2), hash from packed block index to row
    keys: Int64  # (B,), packed index of each block
    values: Float32  # (B, 512), change of the log-odds; 0 = not touched
    used: Int64  # (1,), number of rows in use


class Rays(NamedTuple):
    """Rays from one origin; lengths in cells."""

    origin: Float64  # (3,)
    ends: Float64  # (N, 3), the measured points
    free: Float64  # (N,), length before which every cell is free
    sigma: Float64  # (N,), standard deviation of the measured length; 0 = exact
    hit: Float32  # (N,), log-odds of a certain hit; 0 = the ray ends in nothing
    miss: Float32  # (N,), log-odds of a miss, not above 0


def measure_points(
    xyz: Float32, sigma: Float32, confidence: Float32, T: Float64, max_range: float, margin: float
) -> tuple[Float32, Float32]:
    """Turn points (N, 3) of a camera in metres into rays: their ends, and what is known of each.

    A point farther than ``max_range`` is moved along its ray to that range and is no hit. Free
    space ends ``margin`` standard deviations before a point. ``T`` is from camera axes to cells of
    the map, a rotation times a scale.

    Returns float32 (N, 3), ends in cells of the map, and float32 (N, 4): standard deviation of the
    length and free length (cells), confidence, and 1 where the ray hits or 0.
    """
    ends = np.empty((len(xyz), 3), np.float32)
    values = np.empty((len(xyz), 4), np.float32)
    scale = float(np.linalg.norm(T[0, :3]))
    limits = (scale, max_range, margin)
    _measure_points(xyz, sigma, confidence, T, limits, (ends, values))
    return ends, values


@kernel
def _measure_points(
    xyz: Float32,
    sigma: Float32,
    confidence: Float32,
    T: Float64,
    limits: tuple[float, float, float],
    out: tuple[Float32, Float32],
) -> None:
    scale, max_range, margin = limits
    ends, values = out
    for n in range(len(xyz)):
        x, y, z = np.float64(xyz[n, 0]), np.float64(xyz[n, 1]), np.float64(xyz[n, 2])
        metres = math.sqrt(x * x + y * y + z * z)
        length = scale * metres
        # The error lies along the optical axis: along an oblique ray it is longer.
        spread = scale * sigma[n] * metres / max(abs(z), MIN_DEPTH_M)
        near = length <= max_range
        shrink = 1.0 if near else max_range / length
        for axis in range(3):
            turned = T[axis, 0] * x + T[axis, 1] * y + T[axis, 2] * z
            ends[n, axis] = T[axis, 3] + shrink * turned
        values[n, 0] = spread
        # A ray without a hit ends a cell before the range, where a hit could still be.
        values[n, 1] = min(length - margin * spread, max_range - 1.0)
        values[n, 2] = confidence[n]
        values[n, 3] = 1.0 if near else 0.0


@kernel
def limit_points(
    xyz: Float32, sigma: Float32, max_range: float, beyond: float, margin: float
) -> tuple[Float32, Float32]:
    """Move points (N, 3) out of range along their rays to the distance ``beyond``.

    They are no hits anyway, and at one distance they can be averaged. A ray must stay free as far
    as before, up to ``margin`` standard deviations before its point, so the standard deviation of
    the depth shrinks by as much as the point moves, down to none.
    """
    moved, left = xyz.copy(), sigma.copy()
    for n in range(len(xyz)):
        x, y, z = np.float64(xyz[n, 0]), np.float64(xyz[n, 1]), np.float64(xyz[n, 2])
        length = math.sqrt(x * x + y * y + z * z)
        if length <= max_range:
            continue
        # A point between the two is moved outwards, and its free length does not change either.
        shrink = beyond / length
        surplus = np.float64(sigma[n]) * margin - abs(z) * (1.0 - shrink)
        left[n] = max(surplus, 0.0) / margin if margin > 0 else sigma[n]
        moved[n, 0], moved[n, 1], moved[n, 2] = x * shrink, y * shrink, z * shrink
    return moved, left


def make_blocks(rows: int) -> Blocks:
    """No blocks yet, memory for ``rows``, without evidence."""
    return Blocks(
        table=make_table(rows),
        keys=np.zeros(rows, np.int64),
        values=np.zeros((rows, BLOCK_CELLS), np.float32),
        used=np.zeros(1, np.int64),
    )


@kernel
def block_key(i: int, j: int, k: int) -> int:
    """Packed index of the block that a cell lies in."""
    return int(pack_key(i >> BLOCK_BITS, j >> BLOCK_BITS, k >> BLOCK_BITS))


@kernel
def cell_in_block(i: int, j: int, k: int) -> int:
    """Column of a cell in the row of its block."""
    return ((i & _LOW) << (2 * BLOCK_BITS)) | ((j & _LOW) << BLOCK_BITS) | (k & _LOW)


def cast_rays(evidence: Blocks, rays: Rays, spread: float) -> Blocks:
    """Collect the evidence of the rays of one frame; return the stores that hold it.

    The cells that a ray leaves before its length reaches ``free`` are missed. Where it hits, the
    cells that touch ``length ± spread·sigma`` get ``hit`` times the fraction of the normal
    distribution between the ray's entry and exit. Of several hits the largest counts, of several
    misses the strongest, and a hit outweighs misses; so the order of rays is irrelevant. A ray of
    zero length says nothing.
    """
    done = 0
    # Plain tuples: numba's cache on disk would remember the classes by name, and break when one is
    # renamed.
    while (done := _cast_rays(tuple(evidence), tuple(rays), done, spread, False)) < len(rays.ends):
        evidence = reserve(evidence, len(evidence.keys) + 1, make_blocks)
    return evidence


def blocks_of(keys: Int64) -> Blocks:
    """Blocks of packed indices (B,), each once and in this order, without evidence."""
    blocks = make_blocks(len(keys))
    blocks.keys[:], blocks.used[0] = keys, len(keys)
    enter_keys(blocks.table, keys)
    return blocks


def cast_rays_into(blocks: Blocks, rays: Rays, spread: float) -> None:
    """Collect the evidence of the rays of one frame in these blocks alone, as `cast_rays` does."""
    _cast_rays(tuple(blocks), tuple(rays), 0, spread, True)


@kernel
def _cast_rays(
    evidence: tuple[NDArray[Any], ...],
    rays: tuple[NDArray[Any], ...],
    start: int,
    spread: float,
    known: bool,
) -> int:
    """Cast from ray ``start`` on; return the first that finds no memory left, to be cast again.

    ``known``: cells in other blocks than those that are there are passed.
    """
    # Arrays are taken out of their tuples once: inside the loops numba would count references.
    table, keys, rows_of_cells, used = evidence
    origin, ends, frees, sigmas, hits, misses = rays
    values, rows = rows_of_cells.reshape(-1), used[0]
    ox, oy, oz = origin[0], origin[1], origin[2]
    for n in range(start, len(ends)):
        dx, dy, dz = ends[n, 0] - ox, ends[n, 1] - oy, ends[n, 2] - oz
        length = math.sqrt(dx * dx + dy * dy + dz * dz)
        if length == 0:
            continue
        free, sigma, hit, miss = frees[n], sigmas[n], hits[n], misses[n]
        near = length - spread * sigma if hit > 0 else np.inf
        stop = max(free, length + spread * sigma) if hit > 0 else free
        i, j, k = math.floor(ox), math.floor(oy), math.floor(oz)
        step_x, next_x, delta_x = _axis(ox, dx / length, i)
        step_y, next_y, delta_y = _axis(oy, dy / length, j)
        step_z, next_z, delta_z = _axis(oz, dz / length, k)
        # One number says where the ray is: a step adds to it, and three bits of each axis are the
        # cell in its block.
        place, block, first = pack_key(i, j, k), -1, 0
        stride_x, stride_y, stride_z = step_x * _ALONG_X, step_y * _ALONG_Y, step_z
        enter, below = 0.0, -1.0
        while True:
            leave = min(next_x, next_y, next_z)
            touched = leave > near
            if touched or leave <= free:
                if place & _CORNER != block:
                    block = place & _CORNER
                    i, j, k = unpack_key(place)
                    key = block_key(i, j, k)
                    if known:
                        row = find(table, key)
                    elif rows == len(keys):
                        used[0] = rows
                        return n
                    else:
                        row = find_or_add(table, key, rows)
                        if row == rows:
                            keys[row] = key
                            rows += 1
                    first = row * BLOCK_CELLS
                if first < 0:
                    below = -1.0
                else:
                    cell = first + _cell_at(place)
                    value = values[cell]
                    if touched:
                        if below < 0:
                            below = _normal_cdf(enter, length, sigma)
                        above = _normal_cdf(leave, length, sigma)
                        gain = np.float32(hit * (above - below))
                        below = above
                        if gain > 0 and gain > value:
                            values[cell] = gain
                    elif value <= 0 and miss < value:
                        values[cell] = miss
            if leave >= stop:
                break
            enter = leave
            # Without branches, which no processor can foretell.
            along_x = (next_x <= next_y) & (next_x <= next_z)
            along_y = (not along_x) & (next_y <= next_z)
            next_x += delta_x if along_x else 0.0
            next_y += delta_y if along_y else 0.0
            next_z += 0.0 if along_x | along_y else delta_z
            place += stride_x if along_x else (stride_y if along_y else stride_z)
    used[0] = rows
    return len(ends)


@kernel
def _cell_at(place: int) -> int:
    """Column of a packed cell in the row of its block."""
    high = (place >> (2 * (KEY_BITS - BLOCK_BITS))) & (_LOW << (2 * BLOCK_BITS))
    return high | ((place >> (KEY_BITS - BLOCK_BITS)) & (_LOW << BLOCK_BITS)) | (place & _LOW)


@kernel
def _axis(origin: float, direction: float, cell: int) -> tuple[int, float, float]:
    """Step along one axis, length to the first boundary, length between boundaries."""
    if direction > 0:
        return 1, (cell + 1 - origin) / direction, 1.0 / direction
    if direction < 0:
        return -1, (cell - origin) / direction, -1.0 / direction
    return 0, np.inf, np.inf


@kernel
def _normal_cdf(value: float, mean: float, sigma: float) -> float:
    """Fraction of a normal distribution below ``value``; a step where ``sigma`` is 0."""
    if sigma <= 0:
        return 1.0 if value > mean else 0.0
    return 0.5 * (1.0 + math.erf((value - mean) / (sigma * _SQRT2)))
