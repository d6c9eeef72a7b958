"""Leaves of octrees: the reference, pieces of any size, and what is no tree."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from recon.io.kernels.octree import Leaves, begin_walk, find_leaves
from tests.io.kernels.octree_reference import Leaf, find_leaves_reference

DEPTH = 4


@st.composite
def trees(draw: st.DrawFn) -> list[int]:
    """The children of each node of a tree, depth first."""

    def below(level: int) -> list[int]:
        bits = draw(st.integers(0, 255)) if level < DEPTH and draw(st.booleans()) else 0
        return [bits, *(node for _ in range(bits.bit_count()) for node in below(level + 1))]

    return below(0)


def _listed(leaves: Leaves, first: int = 0) -> list[Leaf]:
    return [
        (first + node, level, tuple(place))
        for node, level, place in zip(
            leaves.nodes.tolist(), leaves.levels.tolist(), leaves.places.tolist(), strict=True
        )
    ]


@settings(max_examples=50)
@given(trees(), st.integers(1, 7))
def test_the_kernel_finds_what_the_reference_finds_in_pieces_of_any_size(
    tree: list[int], size: int
) -> None:
    children, walk, found = np.array(tree, np.uint8), begin_walk(DEPTH), []
    for first in range(0, len(children), size):
        piece = children[first : first + size]
        seen, leaves = find_leaves(piece, walk)
        assert seen == len(piece)
        found += _listed(leaves, first)
    assert found == find_leaves_reference(tree)
    assert walk.level[0] == -1  # the tree is whole


@settings(max_examples=20)
@given(trees(), st.integers(0, 255))
def test_nodes_behind_the_end_of_the_tree_are_not_walked_over(tree: list[int], more: int) -> None:
    seen, leaves = find_leaves(np.array([*tree, more], np.uint8), begin_walk(DEPTH))
    assert seen == len(tree)
    assert len(leaves.nodes) == len(find_leaves_reference(tree))


def test_a_tree_that_is_cut_does_not_end() -> None:
    walk = begin_walk(DEPTH)
    assert find_leaves(np.array([0b101, 0], np.uint8), walk)[0] == 2
    assert walk.level[0] == 1


@pytest.mark.parametrize("depth", [1, 3, 16])
def test_children_below_the_deepest_level_end_the_walk(depth: int) -> None:
    chain = np.full(depth + 1, 0b10000000, np.uint8)
    seen, leaves = find_leaves(chain, begin_walk(depth))
    assert (seen, len(leaves.nodes)) == (depth, 0)


def test_a_chain_of_last_children_ends_in_the_last_cell() -> None:
    _, leaves = find_leaves(np.array([128] * 16 + [0], np.uint8), begin_walk(16))
    assert _listed(leaves) == [(16, 16, (65535, 65535, 65535))]
