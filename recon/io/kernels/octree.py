"""Finds the leaves of an octree from the bits that say which children each node has.

Nodes come depth first, the children of a node in the order of their numbers (bit 0 is x, bit 1 y,
bit 2 z). A walk can stop after any node and go on, so a tree of any size is read in pieces. The
reference implementation is in `tests/io/kernels/test_octree.py`.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from recon.core.kernels.compiled import kernel


class TreeWalk(NamedTuple):
    """The nodes above the next one, which a walk goes on from."""

    # int64 (1,), that of the next node: 0 = the root, -1 = none, all were seen
    level: NDArray[np.int64]
    # uint8 (D,), for the node above on each level, the children that are still to come
    left: NDArray[np.uint8]
    places: NDArray[np.int32]  # int32 (D, 3), where that node is, in cubes of its level


class Leaves(NamedTuple):
    """Nodes without children."""

    nodes: NDArray[np.int64]  # int64 (N,), their numbers among those walked over
    levels: NDArray[np.int64]  # int64 (N,)
    places: NDArray[np.int32]  # int32 (N, 3), in cubes of their level, from 0 to ``2^level - 1``


def begin_walk(depth: int) -> TreeWalk:
    """Return a walk before the root of a tree whose deepest leaves are on the level ``depth``."""
    return TreeWalk(
        np.zeros(1, np.int64), np.zeros(depth, np.uint8), np.zeros((depth, 3), np.int32)
    )


def find_leaves(children: NDArray[np.uint8], walk: TreeWalk) -> tuple[int, Leaves]:
    """Walk over the next nodes (N,), a bit for each child; the walk is moved on.

    The result is how many of them belong to the tree (fewer than N where it ends before, or where a
    node has children below the deepest level), and the leaves among them.
    """
    found = Leaves(
        np.empty(len(children), np.int64),
        np.empty(len(children), np.int64),
        np.empty((len(children), 3), np.int32),
    )
    seen, number = _find_leaves(children, walk, found)
    leaves = Leaves(found.nodes[:number], found.levels[:number], found.places[:number])
    return int(seen), leaves


@kernel
def _find_leaves(children: NDArray[np.uint8], walk: TreeWalk, found: Leaves) -> tuple[int, int]:
    level, number = walk.level[0], 0
    for node in range(len(children)):
        if level < 0 or (level == len(walk.left) and children[node]):
            walk.level[0] = level
            return node, number
        x, y, z = _next_place(level, walk)
        if children[node]:
            walk.left[level] = children[node]
            walk.places[level, 0], walk.places[level, 1], walk.places[level, 2] = x, y, z
            level += 1
            continue
        found.nodes[number], found.levels[number] = node, level
        found.places[number, 0], found.places[number, 1], found.places[number, 2] = x, y, z
        number += 1
        while level > 0 and walk.left[level - 1] == 0:
            level -= 1
        level = level if level > 0 else -1
    walk.level[0] = level
    return len(children), number


@kernel
def _next_place(level: int, walk: TreeWalk) -> tuple[int, int, int]:
    if level == 0:
        return 0, 0, 0
    child = 0
    while not (walk.left[level - 1] >> child) & 1:
        child += 1
    walk.left[level - 1] &= ~np.uint8(1 << child)
    above = walk.places[level - 1]
    return (
        2 * above[0] + (child & 1),
        2 * above[1] + ((child >> 1) & 1),
        2 * above[2] + (child >> 2),
    )
