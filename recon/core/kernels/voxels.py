"""A hash of voxels with sums over the points that fall into each, and sets of packed cells.

Three cell indices are packed into one int64 and looked up in an open-addressing table (linear
probing, capacity a power of two, at most half full) that gives a row. Rows are in the order in
which voxels were first seen, so the result does not depend on the hash. Tables and arrays grow
by doubling.

The reference implementation in plain Python is in `tests/core/kernels/test_kernels.py`.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from functools import partial
from typing import Any, Final, NamedTuple, TypeVar

import numpy as np
from numpy.typing import NDArray

from recon.core.kernels.compiled import Bool, Float32, Int32, Int64, UInt8, kernel

KEY_BITS: Final = 21
KEY_LIMIT: Final = 1 << (KEY_BITS - 1)  # cell indices are at least minus this, and less
EMPTY: Final = -1
_MASK: Final = (1 << KEY_BITS) - 1
_MIN_CAPACITY: Final = 1 << 10

Arrays = tuple[NDArray[Any], ...]
# A named tuple of a hash, packed cells, what is stored under each, and the rows in use.
Store = TypeVar("Store", bound=Arrays)


class VoxelSums(NamedTuple):
    """Sums per voxel, one row each."""

    table: Int64  # (C, 2), hash from packed cell to row (`make_table`)
    keys: Int64  # (R,), packed cells
    #: (R, 4 + C): sum of weights; weighted sums of the offset from the voxel's centre (x, y, z,
    #: metres) and of the C values of each point.
    sums: Float32
    information: Float32  # (R,), sum over frames of the largest weight in each frame
    best: Float32  # (R,), the largest weight in frame ``last``
    frames: Int32  # (R,), number of frames that saw the voxel
    last: Int32  # (R,), the frame that saw it last; -1 = none
    used: Int64  # (1,), number of rows in use


class VoxelPoints(NamedTuple):
    """The points of one frame."""

    xyz: NDArray[np.floating]  # (N, 3), finite, with cells inside ``KEY_LIMIT``
    weights: Float32  # (N,); points with a weight of 0 or less are left out
    values: Float32  # (N, C), numbers to average, such as colours
    # (N,), how often the edge of the voxel of each is doubled; empty = never. The sums of such a
    # voxel are those of the cell in its middle, in its upper half.
    doublings: UInt8 = np.zeros(0, np.uint8)


def make_table(rows: int) -> Int64:
    """Return an empty hash for ``rows`` entries: int64 (C, 2), packed cell (or `EMPTY`) and row."""
    capacity = _MIN_CAPACITY
    while capacity < 2 * rows:
        capacity *= 2
    return np.full((capacity, 2), EMPTY, np.int64)


def make_sums(rows: int, values: int) -> VoxelSums:
    """Return empty rows for voxels whose points carry ``values`` numbers each."""
    return VoxelSums(
        table=make_table(rows),
        keys=np.zeros(rows, np.int64),
        sums=np.zeros((rows, 4 + values), np.float32),
        information=np.zeros(rows, np.float32),
        best=np.zeros(rows, np.float32),
        frames=np.zeros(rows, np.int32),
        last=np.full(rows, -1, np.int32),
        used=np.zeros(1, np.int64),
    )


def copy_sums(voxels: VoxelSums) -> tuple[Int64, Float32]:
    """Return copies of packed cells (N,) and sums (N, 4 + C) of the rows in use."""
    n = int(voxels.used[0])
    return voxels.keys[:n].copy(), voxels.sums[:n].copy()


def reserve_sums(voxels: VoxelSums, rows: int) -> VoxelSums:
    """`reserve` for sums."""
    return reserve(voxels, rows, partial(make_sums, values=voxels.sums.shape[1] - 4))


def reserve(store: Store, rows: int, make: Callable[[int], Store]) -> Store:
    """Return the store, or a copy with ``rows`` rows, or twice as many as before."""
    have, used = len(store[1]), int(store[-1][0])
    if rows <= have:
        return store
    larger = make(max(rows, 2 * have))
    for source, target in zip(store[1:-1], larger[1:-1], strict=True):
        target[:used] = source[:used]
    larger[-1][0] = used
    enter_keys(larger[0], larger[1][:used])
    return larger


def unpack_keys(keys: Int64) -> Int32:
    """Return int32 (N, 3) cell indices of packed cells (N,)."""
    parts = [(keys >> shift) & _MASK for shift in (2 * KEY_BITS, KEY_BITS, 0)]
    return np.asarray(np.stack(parts, axis=1) - KEY_LIMIT, dtype=np.int32)


def pack_keys(cells: NDArray[np.integer[Any]]) -> Int64:
    """Return int64 (N,) packed cells of cell indices (N, 3)."""
    i, j, k = cells.astype(np.int64).T + KEY_LIMIT
    return np.asarray((i << (2 * KEY_BITS)) | (j << KEY_BITS) | k)


@kernel
def pack_key(i: int, j: int, k: int) -> int:
    """Return one int64 of three cell indices in ``[-KEY_LIMIT, KEY_LIMIT)``; never negative."""
    high = (i + KEY_LIMIT) << (2 * KEY_BITS)
    return high | ((j + KEY_LIMIT) << KEY_BITS) | (k + KEY_LIMIT)


@kernel
def unpack_key(key: int) -> tuple[int, int, int]:
    """Return the three cell indices of a packed cell."""
    i, j, k = key >> (2 * KEY_BITS), (key >> KEY_BITS) & _MASK, key & _MASK
    return i - KEY_LIMIT, j - KEY_LIMIT, k - KEY_LIMIT


@kernel
def _place(table: Int64, key: int) -> int:
    """Return the place of a packed cell in a hash, or the unused one where it belongs."""
    # Two rounds of multiplicative hashing; 32-bit factors keep the products inside an int64.
    mask, mixed = len(table) - 1, ((key >> 32) * 0x9E3779B1 ^ key) & 0x7FFFFFFF
    place = ((mixed * 0x85EBCA6B) >> 22) & mask
    while table[place, 0] != EMPTY and table[place, 0] != key:
        place = (place + 1) & mask
    return place


@kernel
def find_or_add(table: Int64, key: int, next_row: int) -> int:
    """Return the row of a packed cell, or enter it with ``next_row``; there is an unused place."""
    place = _place(table, key)
    if table[place, 0] == EMPTY:
        table[place, 0] = key
        table[place, 1] = next_row
    return int(table[place, 1])


@kernel
def find(table: Int64, key: int) -> int:
    """Return the row of a packed cell, or `EMPTY` where it is not in the hash."""
    # Of unused places the row is `EMPTY`, too.
    return int(table[_place(table, key), 1])


@kernel
def find_or_append(table: Int64, keys: Int64, used: Int64, key: int) -> int:
    """Return the row of a packed cell; where it is new it gets the next row, which must exist."""
    row: int = find_or_add(table, key, used[0])
    if row == used[0]:
        keys[row] = key
        used[0] += 1
    return row


@kernel
def enter_keys(table: Int64, keys: Int64) -> None:
    """Enter the cells of rows 0 … N - 1 into an empty hash."""
    for row in range(len(keys)):
        find_or_add(table, keys[row], row)


def add_points(voxels: VoxelSums, points: VoxelPoints, edge: float, frame: int) -> VoxelSums:
    """Add the points of one frame; the rows are written, or replaced by larger ones where full.

    ``edge`` is that of a voxel in the unit of the points; frames come in order.
    """
    done = 0
    # Plain tuples: numba's cache on disk would remember the classes by name, and break when one is
    # renamed.
    while (done := _add_points(tuple(voxels), tuple(points), edge, frame, done)) < len(points.xyz):
        voxels = reserve_sums(voxels, len(voxels.keys) + 1)
    return voxels


@kernel
def _add_points(voxels: Arrays, points: Arrays, edge: float, frame: int, start: int) -> int:
    """Add points from ``start`` on; return the first that finds no memory left."""
    table, keys, sums, information, best, frames, last, used = voxels
    xyz, weights, values, doublings = points
    columns, rows = values.shape[1], used[0]
    for n in range(start, len(xyz)):
        w = weights[n]
        if not w > 0:
            continue
        if rows == len(keys):
            used[0] = rows
            return n
        x, y, z = xyz[n, 0] / edge, xyz[n, 1] / edge, xyz[n, 2] / edge
        i, j, k = math.floor(x), math.floor(y), math.floor(z)
        if len(doublings) and doublings[n]:
            by = np.int64(doublings[n])
            half = 1 << (by - 1)
            i, j, k = (i >> by << by) + half, (j >> by << by) + half, (k >> by << by) + half
        key = pack_key(i, j, k)
        row = find_or_add(table, key, rows)
        if row == rows:
            keys[row] = key
            rows += 1
        sums[row, 0] += w
        sums[row, 1] += w * np.float32((x - i - 0.5) * edge)
        sums[row, 2] += w * np.float32((y - j - 0.5) * edge)
        sums[row, 3] += w * np.float32((z - k - 0.5) * edge)
        for c in range(columns):
            sums[row, 4 + c] += w * values[n, c]
        if last[row] != frame:
            last[row] = frame
            frames[row] += 1
            best[row] = 0
        if w > best[row]:
            information[row] += w - best[row]
            best[row] = w
    used[0] = rows
    return len(xyz)


def add_rows(
    voxels: VoxelSums, keys: Int64, sums: Float32, information: Float32, frames: Int32
) -> VoxelSums:
    """Add what other frames (not those of ``voxels``) summed up: packed cells (N,), each once."""
    voxels = reserve_sums(voxels, int(voxels.used[0]) + len(keys))
    _add_rows(tuple(voxels), keys, sums, information, frames)
    return voxels


@kernel
def _add_rows(
    voxels: Arrays, new_keys: Int64, new_sums: Float32, new_information: Float32, new_frames: Int32
) -> None:
    table, keys, sums, information, _, frames, _, used = voxels
    for n in range(len(new_keys)):
        row = find_or_append(table, keys, used, new_keys[n])
        for c in range(sums.shape[1]):
            sums[row, c] += new_sums[n, c]
        information[row] += new_information[n]
        frames[row] += new_frames[n]


Key = TypeVar("Key", np.int64, np.uint32)


def distinct_keys(keys: NDArray[Key]) -> NDArray[Key]:
    """Return the different keys (N,), sorted: thirty times as fast as numpy's hashing."""
    ordered = np.sort(keys)
    first = np.ones(len(ordered), np.bool_)
    first[1:] = ordered[1:] != ordered[:-1]
    return ordered[first]


def find_keys(wanted: Int64, keys: Int64) -> tuple[NDArray[np.intp], Bool]:
    """Return where in sorted keys the wanted ones (N,) are, and which of them are there."""
    if not len(keys):
        return np.zeros(len(wanted), np.intp), np.zeros(len(wanted), np.bool_)
    place = np.minimum(np.searchsorted(keys, wanted), len(keys) - 1)
    return place, np.asarray(keys[place] == wanted)


def are_among(keys: Int64, others: Int64) -> Bool:
    """Return bool (N,), which keys are among others, in whatever order."""
    return find_keys(keys, np.sort(others))[1]
