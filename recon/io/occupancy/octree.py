"""Encodes OctoMap files branch by branch, without a tree of the whole map in memory.

A branch is a cube with a side of ``2^depth`` cells. Its cells are sorted in Morton order (x is the
lowest bit), so the nodes of each level are runs of cells. Files list nodes depth first, so the
position of every node follows from the sizes of the branches.

Ref: A. Hornung et al., "OctoMap: an efficient probabilistic 3D mapping framework based on
octrees", Autonomous Robots 34, 2013, section 3.4; the formats are those of OctoMap 1.9.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Final

import numpy as np
from numpy.typing import NDArray

from recon.core.values.arrays import Bool, Float32, Int32

DEPTH: Final = 16
KEY_LIMIT: Final = 1 << (DEPTH - 1)
"""Cell indices of an OctoMap lie in ``[-KEY_LIMIT, KEY_LIMIT)`` on each axis."""
FREE, OCCUPIED, INNER = 1, 2, 3
_Index = NDArray[np.int64]


@dataclass(frozen=True)
class Branch:
    """A node with everything below it.

    Attributes:
        full: Its bytes in an ``.ot`` file.
        binary: Its bytes in a ``.bt`` file; empty for a leaf, which is stored in its parent.
        value: Its log-odds: the maximum of the leaves below it.
        kind: 1 = free, 2 = occupied, 3 = has children, in the pruned tree of the ``.bt``.
        nodes: Number of nodes in the ``.ot``, including itself.
        pruned_nodes: Number of nodes in the ``.bt``, including itself.
    """

    full: bytes
    binary: bytes
    value: float
    kind: int
    nodes: int
    pruned_nodes: int


def encode_branch(keys: Int32, log_odds: Float32, depth: int) -> Branch:
    """Encode the branch of a cube of cells.

    Args:
        keys: int32 (N, 3), N ≥ 1, distinct cells of one cube with a side of ``2^depth``.
        log_odds: float32 (N,); 0 and above = occupied.
        depth: At least 1.
    """
    code = _morton(keys.astype(np.int64) & ((1 << depth) - 1), depth)
    order = np.argsort(code)
    levels = [code[order] >> (3 * up) for up in range(depth + 1)]
    values, kinds = [log_odds[order]], [np.where(log_odds[order] >= 0, OCCUPIED, FREE)]
    codes, begins = [levels[0]], []
    for _ in range(depth):
        parent = codes[-1] >> 3
        begin = np.flatnonzero(np.r_[True, parent[1:] != parent[:-1]])
        begins.append(begin)
        values.append(np.maximum.reduceat(values[-1], begin))
        kinds.append(_parents_kind(kinds[-1], begin))
        codes.append(parent[begin])
    full = _encode_full(codes, values, begins)
    binary, pruned_nodes = _encode_binary(codes, kinds, begins)
    return Branch(
        full=full,
        binary=binary,
        value=float(values[-1][0]),
        kind=int(kinds[-1][0]),
        nodes=sum(map(len, codes)),
        pruned_nodes=pruned_nodes,
    )


def join_branches(children: dict[int, Branch]) -> Branch:
    """Return the parent node of some branches: its own bytes only; theirs follow in order.

    Args:
        children: Branches by their index, 0 to 7: bit 0 is x, bit 1 y, bit 2 z.
    """
    value = max(child.value for child in children.values())
    kinds = {child.kind for child in children.values()}
    nodes = 1 + sum(child.nodes for child in children.values())
    mask = sum(1 << place for place in children)
    full = np.float32(value).tobytes() + bytes([mask])
    if len(children) == 8 and kinds in ({FREE}, {OCCUPIED}):
        return Branch(full, b"", value, kinds.pop(), nodes, 1)
    bits = sum(child.kind << (2 * place) for place, child in children.items())
    pruned = 1 + sum(child.pruned_nodes for child in children.values())
    return Branch(full, bits.to_bytes(2, "little"), value, INNER, nodes, pruned)


def _parents_kind(kinds: _Index, begin: _Index) -> _Index:
    """Return kinds of the parents: eight equal leaves become a leaf; others have children."""
    low, high = np.minimum.reduceat(kinds, begin), np.maximum.reduceat(kinds, begin)
    size = np.diff(np.r_[begin, len(kinds)])
    return np.where((size == 8) & (low == high) & (low != INNER), low, INNER)


def _encode_full(codes: list[_Index], values: list[Float32], begins: list[_Index]) -> bytes:
    """Encode every node as its value and one bit per child."""
    everywhere = [np.ones(len(code), dtype=np.bool_) for code in codes]
    places = _places(everywhere, begins, 5)
    out = np.zeros(5 * sum(map(len, codes)), np.uint8)
    for up, (value, place) in enumerate(zip(values, places, strict=True)):
        raw = np.ascontiguousarray(value.astype("<f4")).view(np.uint8).reshape(-1, 4)
        out[place[:, None] + np.arange(4)] = raw
        if up:
            bit = (1 << (codes[up - 1] & 7)).astype(np.uint8)
            out[place + 4] = np.bitwise_or.reduceat(bit, begins[up - 1])
    return out.tobytes()


def _encode_binary(
    codes: list[_Index], kinds: list[_Index], begins: list[_Index]
) -> tuple[bytes, int]:
    """Encode every node that has children as two bits per child; also the number of nodes."""
    inner = [kind == INNER for kind in kinds]
    places = _places(inner, begins, 2)
    out = np.zeros(2 * sum(int(which.sum()) for which in inner), np.uint8)
    nodes = 1
    for up in range(1, len(codes)):
        bits = kinds[up - 1] << (2 * (codes[up - 1] & 7))
        word = np.add.reduceat(bits, begins[up - 1])[inner[up]]
        out[places[up][inner[up]]] = word & 255
        out[places[up][inner[up]] + 1] = word >> 8
        child_counts = np.diff(np.r_[begins[up - 1], len(codes[up - 1])])
        nodes += int(child_counts[inner[up]].sum())
    return out.tobytes(), nodes


def _places(written: list[Bool], begins: list[_Index], size: int) -> list[_Index]:
    """Return the byte offset of each node, per level; nodes that are not written take no bytes."""
    sizes = [size * written[0].astype(np.int64)]
    for up, begin in enumerate(begins, 1):
        below = np.add.reduceat(sizes[-1], begin)
        sizes.append(np.where(written[up], size + below, 0))
    places = [np.zeros(1, np.int64)]
    for up in range(len(begins), 0, -1):
        begin, below = begins[up - 1], sizes[up - 1]
        before = np.cumsum(below) - below
        counts = np.diff(np.r_[begin, len(below)])
        start = np.repeat(places[-1] + size - before[begin], counts)
        places.append(start + before)
    return places[::-1]


def _morton(cells: NDArray[np.int64], depth: int) -> _Index:
    """Return Morton codes of cells (N, 3) in ``[0, 2^depth)``; x is the lowest bit."""
    code = np.zeros(len(cells), np.int64)
    for bit in range(depth):
        for axis in range(3):
            code |= ((cells[:, axis] >> bit) & 1) << (3 * bit + axis)
    return code


def file_header(*, binary: bool, nodes: int, resolution_m: float) -> bytes:
    """Return the header of a file."""
    kind = "# Octomap OcTree binary file" if binary else "# Octomap OcTree file"
    lines = [
        kind,
        "# (feel free to add / change comments, but leave the first line as it is!)",
        "#",
        "id OcTree",
        f"size {nodes}",
        f"res {resolution_m:g}",
        "data",
    ]
    return ("\n".join(lines) + "\n").encode()
