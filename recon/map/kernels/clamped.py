"""Clamped log-odds in blocks of 8×8×8 voxels, such that parts of a drive can be chained later.

A frame changes the log-odds of a cell by ``x → min(max(x + change, lowest), highest)``. Functions
of this form are closed under composition, ``x → min(max(x + sum, low), high)``: three numbers per
cell describe what a part of a drive did to it, whatever was known before, and chaining the parts in
order gives exactly what one long drive would have given. Adding up clamped log-odds would not: a
car that was seen ten times in one part, and looked through ten times in the next, would stay.
"""

from __future__ import annotations

import math
from typing import Any, Final, NamedTuple

import numpy as np
from numpy.typing import NDArray

from recon.core.kernels.compiled import Float32, Float64, Int64, UInt16, kernel
from recon.core.kernels.voxels import (
    EMPTY,
    enter_keys,
    find,
    find_or_append,
    make_table,
    pack_keys,
    reserve,
    unpack_key,
    unpack_keys,
)
from recon.map.kernels.raycast import (
    BLOCK_BITS,
    BLOCK_CELLS,
    BLOCK_EDGE,
    Blocks,
    block_key,
    cell_in_block,
)

_LOW: Final = BLOCK_EDGE - 1


class ClampedBlocks(NamedTuple):
    """Blocks of cells, one row each.

    Cell (i, j, k) of a block is column ``(i·8 + j)·8 + k``.
    """

    table: Int64  # (C, 2), hash from packed block index to row
    keys: Int64  # (B,), packed index of each block
    cells: Float32  # (B, 512, 3): sum, low, high of each cell; sum NaN = never observed
    used: Int64  # (1,), number of rows in use


class CellRows(NamedTuple):
    """The observed cells of some blocks, one after the other."""

    blocks: Int64  # (B,), packed index of each block
    starts: Int64  # (B + 1,), where the cells of each block begin and the last ones end
    cells: UInt16  # (N,), column of each cell in its block
    values: Float32  # (N, 3), sum, low and high


def make_clamped(rows: int) -> ClampedBlocks:
    """No blocks yet, memory for ``rows``."""
    return ClampedBlocks(
        table=make_table(rows),
        keys=np.zeros(rows, np.int64),
        cells=np.full((rows, BLOCK_CELLS, 3), np.nan, np.float32),
        used=np.zeros(1, np.int64),
    )


def add_evidence(
    blocks: ClampedBlocks, evidence: Blocks, lowest: float, highest: float
) -> ClampedBlocks:
    """Add a frame's evidence to the map, and clear it; return the stores that hold the map.

    Where the map is full, larger ones take its place; log-odds are clamped to the limits.
    """
    blocks = reserve(blocks, int(blocks.used[0]) + int(evidence.used[0]), make_clamped)
    # Plain tuples: numba's cache on disk would remember the classes by name, and break when one
    # is renamed.
    _add_evidence(tuple(blocks), tuple(evidence), lowest, highest)
    return blocks


@kernel
def _add_evidence(
    blocks: tuple[NDArray[Any], ...],
    evidence: tuple[NDArray[Any], ...],
    lowest: float,
    highest: float,
) -> None:
    table, keys, cells, used = blocks
    frame_table, frame_keys, changes, frame_used = evidence
    lo, hi = np.float32(lowest), np.float32(highest)
    for touched in range(frame_used[0]):
        row = find_or_append(table, keys, used, frame_keys[touched])
        for cell in range(BLOCK_CELLS):
            change = changes[touched, cell]
            if change != 0:
                _chain(cells, row, cell, change, lo, hi)
                changes[touched, cell] = 0
    frame_table[:, 0] = EMPTY
    frame_used[0] = 0


@kernel
def _chain(
    cells: Float32, row: int, cell: int, change: np.float32, low: np.float32, high: np.float32
) -> None:
    """Compose what was done to a cell with ``x → min(max(x + change, low), high)``."""
    before = cells[row, cell, 0]
    if np.isnan(before):
        cells[row, cell, 0] = change
        cells[row, cell, 1] = low
        cells[row, cell, 2] = high
    else:
        cells[row, cell, 0] = before + change
        cells[row, cell, 1] = min(max(cells[row, cell, 1] + change, low), high)
        cells[row, cell, 2] = min(max(cells[row, cell, 2] + change, low), high)


def observed_rows(blocks: ClampedBlocks) -> CellRows:
    """The observed cells, block by block as first touched."""
    used = int(blocks.used[0])
    cells = blocks.cells[:used]
    seen = ~np.isnan(cells[:, :, 0])
    starts = np.concatenate([[0], np.cumsum(seen.sum(axis=1))])
    column = np.nonzero(seen)[1]
    return CellRows(
        blocks.keys[:used].copy(), starts.astype(np.int64), column.astype(np.uint16), cells[seen]
    )


def chain_rows(blocks: ClampedBlocks, rows: CellRows) -> ClampedBlocks:
    """Chain a later part of a drive: do to the returned map what it did to each cell."""
    blocks = reserve(blocks, int(blocks.used[0]) + len(rows.blocks), make_clamped)
    _chain_rows(tuple(blocks), tuple(rows))
    return blocks


@kernel
def _chain_rows(blocks: tuple[NDArray[Any], ...], rows: tuple[NDArray[Any], ...]) -> None:
    table, keys, cells, used = blocks
    new_blocks, starts, columns, values = rows
    for block in range(len(new_blocks)):
        row = find_or_append(table, keys, used, new_blocks[block])
        for n in range(starts[block], starts[block + 1]):
            _chain(cells, row, columns[n], values[n, 0], values[n, 1], values[n, 2])


def move_blocks(blocks: ClampedBlocks, T_new_old: Float64) -> ClampedBlocks:
    """The map turned and shifted: each new cell takes what the old cell at its centre has.

    ``T_new_old`` is a rigid motion with its translation in cells.
    """
    targets = _blocks_reached(blocks, T_new_old)
    moved = make_clamped(max(1, len(targets)))
    moved.keys[: len(targets)] = targets
    moved.used[0] = len(targets)
    enter_keys(moved.table, targets)
    T_old_new = np.asarray(np.linalg.inv(T_new_old), np.float64)
    _fill_moved(tuple(blocks), tuple(moved), T_old_new)
    return moved


def _blocks_reached(blocks: ClampedBlocks, T_new_old: Float64) -> Int64:
    """Packed indices of all blocks that a moved block may touch, in order."""
    corners = unpack_keys(blocks.keys[: int(blocks.used[0])]) * BLOCK_EDGE
    centres = corners + BLOCK_EDGE / 2
    home = np.floor((centres @ T_new_old[:3, :3].T + T_new_old[:3, 3]) / BLOCK_EDGE)
    around = np.stack(np.unravel_index(np.arange(27), (3, 3, 3)), axis=1) - 1
    return np.unique(pack_keys((home[:, None].astype(np.int64) + around).reshape(-1, 3)))


@kernel
def _fill_moved(
    old: tuple[NDArray[Any], ...], new: tuple[NDArray[Any], ...], T_old_new: Float64
) -> None:
    table, _, old_cells, _ = old
    _, keys, new_cells, used = new
    last_key, last_row = -1, -1
    for row in range(used[0]):
        bi, bj, bk = unpack_key(keys[row])
        for cell in range(BLOCK_CELLS):
            x = bi * BLOCK_EDGE + (cell >> (2 * BLOCK_BITS)) + 0.5
            y = bj * BLOCK_EDGE + ((cell >> BLOCK_BITS) & _LOW) + 0.5
            z = bk * BLOCK_EDGE + (cell & _LOW) + 0.5
            T = T_old_new
            i = math.floor(T[0, 0] * x + T[0, 1] * y + T[0, 2] * z + T[0, 3])
            j = math.floor(T[1, 0] * x + T[1, 1] * y + T[1, 2] * z + T[1, 3])
            k = math.floor(T[2, 0] * x + T[2, 1] * y + T[2, 2] * z + T[2, 3])
            key = block_key(i, j, k)
            if key != last_key:
                last_key, last_row = key, find(table, key)
            if last_row == EMPTY:
                continue
            place = cell_in_block(i, j, k)
            for n in range(3):
                new_cells[row, cell, n] = old_cells[last_row, place, n]
