"""Reads the cells of an OctoMap ``.ot`` file piece by piece, without a whole tree in memory.

Ref: A. Hornung et al., "OctoMap: an efficient probabilistic 3D mapping framework based on
octrees", Autonomous Robots 34, 2013, section 3.4; the format is that of OctoMap 1.9.
"""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path
from typing import IO, Final

import numpy as np
from numpy.typing import NDArray

from recon.core.errors import FormatError
from recon.core.values import OccupancyVoxels
from recon.core.values.arrays import Int32
from recon.io.files import reading
from recon.io.kernels.octree import Leaves, TreeWalk, begin_walk, find_leaves
from recon.io.occupancy.octree import DEPTH, KEY_LIMIT

FULL_TREE: Final = b"# Octomap OcTree file"
_NODE: Final = np.dtype([("log_odds", "<f4"), ("children", "u1")])
_LONGEST_HEADER_LINES: Final = 100
#: Level of the largest leaf accepted; a larger one would expand to too many cells for memory.
_COARSEST: Final = DEPTH - 8


def octomap_pieces(path: Path, nodes_each: int = 1 << 19) -> Iterator[OccupancyVoxels]:
    """Read the cells of an ``.ot`` file in file order, in at least one piece.

    Leaves that cover several cells are expanded.

    Args:
        path: The file.
        nodes_each: Number of tree nodes to read at a time.

    Raises:
        FormatError: The file is missing, truncated, damaged or not an ``.ot`` file.
    """
    with reading(path), path.open("rb") as file:
        yield from _pieces(file, path, nodes_each)


def _pieces(file: IO[bytes], path: Path, nodes_each: int) -> Iterator[OccupancyVoxels]:
    left, resolution_m = _read_header(file, path)
    if not left:
        yield OccupancyVoxels(np.zeros((0, 3), np.int32), np.zeros(0, np.float32), resolution_m)
    walk = begin_walk(DEPTH)
    while left:
        count = min(left, nodes_each)
        left -= count
        content = file.read(count * _NODE.itemsize)
        nodes = np.frombuffer(content, _NODE, len(content) // _NODE.itemsize)
        found = _cells(nodes, walk, resolution_m)
        ends = walk.level[0] < 0
        if len(nodes) < count or found is None or ends == bool(left):
            raise FormatError("the OctoMap is truncated or damaged", where=path)
        yield found


def _cells(nodes: NDArray[np.void], walk: TreeWalk, resolution_m: float) -> OccupancyVoxels | None:
    """Return the cells of the next nodes; None if they do not fit the tree."""
    seen, leaves = find_leaves(np.ascontiguousarray(nodes["children"]), walk)
    log_odds = nodes["log_odds"][leaves.nodes]
    coarse = (leaves.levels < _COARSEST).any()
    if seen < len(nodes) or coarse or not np.isfinite(log_odds).all():
        return None
    keys, leaf = _expand(leaves)
    return OccupancyVoxels(keys, log_odds[leaf], resolution_m)


def _expand(leaves: Leaves) -> tuple[Int32, NDArray[np.intp]]:
    """Expand leaves of any size to cells, with the leaf that each belongs to."""
    keys, source = [np.zeros((0, 3), np.int32)], [np.zeros(0, np.intp)]
    for level in np.unique(leaves.levels).tolist():
        edge = 1 << (DEPTH - level)
        which = np.flatnonzero(leaves.levels == level)
        inside = np.stack(np.unravel_index(np.arange(edge**3), (edge,) * 3), axis=1)
        corners = leaves.places[which].astype(np.int32) * edge - KEY_LIMIT
        keys.append((corners[:, None] + inside.astype(np.int32)).reshape(-1, 3))
        source.append(np.repeat(which, edge**3))
    return np.concatenate(keys), np.concatenate(source)


def _read_header(file: IO[bytes], path: Path) -> tuple[int, float]:
    """Read the number of nodes and the cell size; leave the file just after the header."""
    first = file.readline(200).strip()
    if first != FULL_TREE:
        raise FormatError("not an .ot OctoMap file", where=path, got=first[:40])
    fields: dict[bytes, bytes] = {}
    for _ in range(_LONGEST_HEADER_LINES):
        name, _, value = file.readline(200).strip().partition(b" ")
        if name == b"data":
            break
        fields[name] = value
    try:
        nodes, resolution_m = int(fields[b"size"]), float(fields[b"res"])
    except (KeyError, ValueError) as error:
        raise FormatError("the OctoMap is truncated or damaged", where=path) from error
    if fields.get(b"id") != b"OcTree" or nodes < 0 or not 0 < resolution_m < np.inf:
        raise FormatError(
            "the file has no occupancy octree", where=path, got=fields.get(b"id", b"")[:40]
        )
    return nodes, resolution_m
