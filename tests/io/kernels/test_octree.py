"""Leaves of octrees: the reference, pieces of any size, and what is no tree."""

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from recon.io.kernels.octree import Leaves, begin_walk, find_leaves

DEPTH = 4
Place = tuple[int, int, int]
Leaf = tuple[int, int, Place]  # its number, level and place


def find_leaves_reference(nodes, level=0, place=(0, 0, 0)):
    """The same walk by recursion, over numbered nodes with a bit for each of their children."""
    node, children = next(nodes)
    if not children:
        yield node, level, place
    x, y, z = (2 * coordinate for coordinate in place)
    for child in range(8):
        if children >> child & 1:
            corner = (x + (child & 1), y + (child >> 1 & 1), z + (child >> 2))
            yield from find_leaves_reference(nodes, level + 1, corner)


@st.composite
def trees(draw: st.DrawFn) -> list[int]:
    """The children of each node of a tree, depth first."""

    def below(level: int) -> list[int]:
        bits = draw(st.integers(0, 255)) if level < DEPTH and draw(st.booleans()) else 0
        return [bits, *(node for _ in range(bits.bit_count()) for node in below(level + 1))]

    return below(0)


def listed(leaves: Leaves, first: int = 0) -> list[Leaf]:
    found = zip(*(part.tolist() for part in leaves), strict=True)
    return [(first + node, level, tuple(place)) for node, level, place in found]


@settings(max_examples=50)
@given(trees(), st.integers(1, 7))
def test_the_kernel_finds_what_the_reference_finds_in_pieces_of_any_size(tree, size):
    children, walk, found = np.array(tree, np.uint8), begin_walk(DEPTH), []
    for first in range(0, len(children), size):
        piece = children[first : first + size]
        seen, leaves = find_leaves(piece, walk)
        assert seen == len(piece)
        found += listed(leaves, first)
    assert found == list(find_leaves_reference(enumerate(tree)))
    assert walk.level[0] == -1  # the tree is whole


@settings(max_examples=20)
@given(trees(), st.integers(0, 255))
def test_nodes_behind_the_end_of_the_tree_are_not_walked_over(tree, more):
    seen, leaves = find_leaves(np.array([*tree, more], np.uint8), begin_walk(DEPTH))
    assert (seen, len(leaves.nodes)) == (len(tree), tree.count(0))


def test_a_tree_that_is_cut_does_not_end():
    walk = begin_walk(DEPTH)
    assert find_leaves(np.array([0b101, 0], np.uint8), walk)[0] == 2
    assert walk.level[0] == 1


@pytest.mark.parametrize("depth", [1, 3, 16])
def test_children_below_the_deepest_level_end_the_walk(depth):
    chain = np.full(depth + 1, 0b10000000, np.uint8)
    seen, leaves = find_leaves(chain, begin_walk(depth))
    assert (seen, len(leaves.nodes)) == (depth, 0)
    chain[-1] = 0  # a chain of last children ends in the last cell
    last = 2**depth - 1
    _, leaves = find_leaves(chain, begin_walk(depth))
    assert listed(leaves) == [(depth, depth, (last, last, last))]
