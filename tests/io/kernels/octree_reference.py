"""Reference implementation of `recon.io.kernels.octree`: the same walk by recursion."""

from __future__ import annotations

from collections.abc import Iterator, Sequence

Leaf = tuple[int, int, tuple[int, int, int]]


def find_leaves_reference(children: Sequence[int]) -> list[Leaf]:
    """Return the number, level and place of each leaf of a whole tree.

    Args:
        children: For each node, depth first, a bit for each of its children.
    """
    return list(_below(iter(enumerate(children)), 0, (0, 0, 0)))


def _below(
    nodes: Iterator[tuple[int, int]], level: int, place: tuple[int, int, int]
) -> Iterator[Leaf]:
    node, children = next(nodes)
    if not children:
        yield node, level, place
    x, y, z = (2 * coordinate for coordinate in place)
    for child in range(8):
        if children >> child & 1:
            corner = (x + (child & 1), y + (child >> 1 & 1), z + (child >> 2))
            yield from _below(nodes, level + 1, corner)
