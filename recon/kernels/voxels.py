"""A hash of voxels, and sums over the points that fall into each.

Three cell indices are packed into one int64 and looked up in an open-addressing table (linear
probing, capacity a power of two, at most half full). The table gives a row number; what is
stored of a voxel lies in arrays under that row, in the order in which voxels were first seen, so
the result does not depend on the hash. Tables and rows grow by doubling: adding a point costs a
constant time on average, however large the map is.

The twins in plain Python stand in `recon.kernels.voxels_reference`.
"""

from __future__ import annotations

from typing import Any, Final, NamedTuple

import numpy as np
from numba import njit
from numpy.typing import NDArray

KEY_BITS: Final = 21
KEY_LIMIT: Final = 1 << (KEY_BITS - 1)
"""Cell indices lie in ``[-KEY_LIMIT, KEY_LIMIT)``: 100 km to each side at 0.1 m."""
EMPTY: Final = -1
_MASK: Final = (1 << KEY_BITS) - 1
_MIN_CAPACITY: Final = 1 << 10


class VoxelTable(NamedTuple):
    """Open-addressing hash from packed cell to row.

    Attributes:
        keys: int64 (C,), packed cells; `EMPTY` = unused. C is a power of two.
        rows: int32 (C,), row of each.
    """

    keys: NDArray[np.int64]
    rows: NDArray[np.int32]


class VoxelSums(NamedTuple):
    """What is summed up per voxel; one row each.

    Attributes:
        keys: int64 (R,), packed cells.
        sums: float32 (R, 4 + C): sum of weights; weighted sums of the offset from the voxel's
            centre (x, y, z, metres) and of the C values of each point.
        information: float32 (R,), sum over frames of the largest weight in each frame.
        best: float32 (R,), the largest weight in frame ``last``.
        frames: int32 (R,), number of frames that saw the voxel.
        last: int32 (R,), the frame that saw it last; -1 = none.
        used: int64 (1,), number of rows in use.
    """

    keys: NDArray[np.int64]
    sums: NDArray[np.float32]
    information: NDArray[np.float32]
    best: NDArray[np.float32]
    frames: NDArray[np.int32]
    last: NDArray[np.int32]
    used: NDArray[np.int64]


class VoxelPoints(NamedTuple):
    """The points of one frame.

    Attributes:
        xyz: (N, 3), finite, with cells inside ``KEY_LIMIT``.
        weights: float32 (N,); points with a weight of 0 or less are left out.
        values: float32 (N, C), numbers to average, such as colours.
    """

    xyz: NDArray[np.floating]
    weights: NDArray[np.float32]
    values: NDArray[np.float32]


def make_table(rows: int) -> VoxelTable:
    """An empty table with room for ``rows`` entries."""
    capacity = _MIN_CAPACITY
    while capacity < 2 * rows:
        capacity *= 2
    return VoxelTable(np.full(capacity, EMPTY, np.int64), np.zeros(capacity, np.int32))


def make_sums(rows: int, values: int) -> VoxelSums:
    """Empty rows for voxels whose points carry ``values`` numbers each."""
    return VoxelSums(
        keys=np.zeros(rows, np.int64),
        sums=np.zeros((rows, 4 + values), np.float32),
        information=np.zeros(rows, np.float32),
        best=np.zeros(rows, np.float32),
        frames=np.zeros(rows, np.int32),
        last=np.full(rows, -1, np.int32),
        used=np.zeros(1, np.int64),
    )


def reserve_table(table: VoxelTable, keys: NDArray[np.int64], rows: int) -> VoxelTable:
    """A table with room for ``rows`` entries: the same one, or a larger one that holds ``keys``.

    Args:
        table: The table that there is.
        keys: int64 (U,), packed cells of rows 0 … U - 1.
        rows: Number of entries that must fit.
    """
    if 2 * rows <= len(table.keys):
        return table
    larger = make_table(rows)
    _fill(larger, keys)
    return larger


def reserve_sums(sums: VoxelSums, rows: int) -> VoxelSums:
    """Rows for ``rows`` voxels: the same ones, or twice as many (or more) with the same content."""
    have = len(sums.keys)
    if rows <= have:
        return sums
    larger = make_sums(max(rows, 2 * have), sums.sums.shape[1] - 4)
    copy_rows(sums[:-1], larger[:-1], int(sums.used[0]))
    larger.used[0] = sums.used[0]
    return larger


def copy_rows(old: tuple[NDArray[Any], ...], new: tuple[NDArray[Any], ...], rows: int) -> None:
    """Copy the first ``rows`` rows of each array to its larger successor."""
    for source, target in zip(old, new, strict=True):
        target[:rows] = source[:rows]


def unpack_keys(keys: NDArray[np.int64]) -> NDArray[np.int32]:
    """int32 (N, 3) cell indices of packed cells (N,)."""
    parts = [(keys >> shift) & _MASK for shift in (2 * KEY_BITS, KEY_BITS, 0)]
    return np.asarray(np.stack(parts, axis=1) - KEY_LIMIT, dtype=np.int32)


@njit(cache=True, nogil=True)
def pack_key(i: int, j: int, k: int) -> int:
    """One int64 of three cell indices in ``[-KEY_LIMIT, KEY_LIMIT)``; never negative."""
    high = (i + KEY_LIMIT) << (2 * KEY_BITS)
    return high | ((j + KEY_LIMIT) << KEY_BITS) | (k + KEY_LIMIT)


@njit(cache=True, nogil=True)
def find_or_add(table: VoxelTable, key: int, next_row: int) -> int:
    """Row of a packed cell; where it is new it is entered with ``next_row``.

    The table must have an unused place.
    """
    keys, rows = table
    mask = len(keys) - 1
    # Fibonacci hashing of the key folded to 31 bits: the product stays below 2^63.
    folded = (key ^ (key >> 19) ^ (key >> 38)) & 0x7FFFFFFF
    place = ((folded * 0x9E3779B1) >> 20) & mask
    while keys[place] != EMPTY:
        if keys[place] == key:
            return int(rows[place])
        place = (place + 1) & mask
    keys[place] = key
    rows[place] = next_row
    return next_row


@njit(cache=True, nogil=True)
def _fill(table: VoxelTable, keys: NDArray[np.int64]) -> None:
    """Enter the cells of rows 0 … N - 1 into an empty table."""
    for row in range(len(keys)):
        find_or_add(table, keys[row], row)


@njit(cache=True, nogil=True)
def sum_points(
    table: VoxelTable, voxels: VoxelSums, points: VoxelPoints, edge: float, frame: int
) -> None:
    """Add the points of one frame to the voxels that they fall into.

    Args:
        table: Hash of the voxels, with room for one more entry per point; written.
        voxels: The rows, with room for one more per point; written.
        points: The points; as many values each as the rows have.
        edge: Edge of a voxel, in the unit of the points.
        frame: Number of the frame; frames come in order.
    """
    keys, sums, information, best, frames, last, used = voxels
    xyz, weights, values = points
    columns = values.shape[1]
    for n in range(len(xyz)):
        w = weights[n]
        if not w > 0:
            continue
        x, y, z = xyz[n, 0] / edge, xyz[n, 1] / edge, xyz[n, 2] / edge
        i, j, k = int(np.floor(x)), int(np.floor(y)), int(np.floor(z))
        key = pack_key(i, j, k)
        row = find_or_add(table, key, used[0])
        if row == used[0]:
            keys[row] = key
            used[0] += 1
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
