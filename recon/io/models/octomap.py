"""OctoMap files: ``.ot`` with log-odds, ``.bt`` with only occupied and free; in pieces.

A branch is a cube with a side of ``2^depth`` cells, in Morton order (x is the lowest bit), so that
the nodes of each level are runs of cells. Files list nodes depth first: the position of every node
follows from the sizes of the branches.

Ref: A. Hornung et al., "OctoMap: an efficient probabilistic 3D mapping framework based on octrees",
Autonomous Robots 34, 2013, section 3.4; the format is that of OctoMap 1.9.
"""

from __future__ import annotations

from collections.abc import Iterable, Iterator
from dataclasses import dataclass, field, replace
from pathlib import Path
from tempfile import TemporaryFile
from typing import IO, Final

import numpy as np
from numpy.typing import NDArray

from recon.core.errors import FormatError, MappingError
from recon.core.kernels.voxels import pack_keys
from recon.core.text import parse_integer, parse_number
from recon.core.values import OccupancyVoxels, join_voxels
from recon.core.values.arrays import Bool, Float32, Int32
from recon.io.atomic import atomic_path
from recon.io.files import StrPath, reader, reading
from recon.io.kernels.octree import TreeWalk, begin_walk, find_leaves

DEPTH: Final = 16
KEY_LIMIT: Final = 1 << (DEPTH - 1)  # cell indices lie in [-KEY_LIMIT, KEY_LIMIT) on each axis
FREE, OCCUPIED, INNER = 1, 2, 3
#: Level of the largest leaf accepted; a larger one would expand to too many cells for memory.
_COARSEST: Final = DEPTH - 8
_Index = NDArray[np.int64]
Cube = tuple[int, int, int]
_FULL_TREE, _BINARY_TREE = b"# Octomap OcTree file", b"# Octomap OcTree binary file"
_HEADER: Final = """
# (feel free to add / change comments, but leave the first line as it is!)
#
id OcTree
size {}
res {:g}
data
"""
_DAMAGED: Final = "the OctoMap is truncated or damaged"
_NODE: Final = np.dtype([("log_odds", "<f4"), ("children", "u1")])
_LONGEST_HEADER_LINES: Final = 100
_FEW_CELLS: Final = 1 << 22
_MOST_GROWTH: Final = 64  # cells per node of a larger piece: five bytes can claim 16 million


def write_octomap_tiles(
    path: StrPath, tiles: Iterable[OccupancyVoxels], depth: int, resolution_m: float
) -> tuple[Path, Path]:
    """Write ``path.bt`` and ``.ot`` from tiles of whole cubes of side ``2^depth``, in turn."""
    stem = Path(path)
    binary, full = (stem.with_name(f"{stem.name}.{end}") for end in ("bt", "ot"))
    with (
        atomic_path(binary) as to_binary,
        atomic_path(full) as to_full,
        TemporaryFile(dir=stem.parent) as pieces,
    ):
        root = _tree([node for tile in tiles for node in _nodes(tile, depth, pieces)], depth)
        for target, is_binary in ((to_binary, True), (to_full, False)):
            with target.open("wb") as file:
                kind, nodes = _BINARY_TREE if is_binary else _FULL_TREE, 0
                if root is not None:
                    nodes = root.branch.pruned_nodes if is_binary else root.branch.nodes
                file.write(kind + _HEADER.format(nodes, resolution_m).encode())
                if root is not None:
                    _write_node(file, root, pieces, binary=is_binary)
    return binary, full


@dataclass
class _Node:
    """A node above the cubes, or the root of a cube, whose bytes are in the temporary file."""

    cube: Cube  # its index among the cubes of its size
    branch: Branch
    children: dict[int, _Node] = field(default_factory=dict)  # child nodes, by their index 0 to 7
    full: tuple[int, int] = (0, 0)  # bytes of a cube in the temporary file, for the ``.ot``
    binary: tuple[int, int] = (0, 0)  # the same, for the ``.bt``


def _nodes(voxels: OccupancyVoxels, depth: int, pieces: IO[bytes]) -> list[_Node]:
    """Return nodes for the cubes of a tile; their bytes are appended to ``pieces``."""
    if len(voxels) == 0:
        return []
    if voxels.keys.min() < -KEY_LIMIT or voxels.keys.max() >= KEY_LIMIT:
        raise MappingError(
            "the map is too large for an OctoMap of this resolution",
            got=f"{np.abs(voxels.keys).max() * voxels.resolution_m:.0f} m from the origin",
            expected=f"at most {KEY_LIMIT * voxels.resolution_m:.0f} m",
        )
    cubes = (voxels.keys.astype(np.int64) + KEY_LIMIT) >> depth
    number = pack_keys(cubes)  # numpy sorts rows slowly
    order = np.argsort(number, kind="stable")
    begins = np.flatnonzero(np.diff(number[order], prepend=number[order[:1]] - 1))
    nodes = []
    for inside in np.split(order, begins[1:]):
        branch = encode_branch(voxels.keys[inside], voxels.log_odds[inside], depth)
        x, y, z = cubes[inside[0]].tolist()
        node = _Node((x, y, z), replace(branch, full=b"", binary=b""))
        node.full, node.binary = _append(pieces, branch.full), _append(pieces, branch.binary)
        nodes.append(node)
    return nodes


def _append(pieces: IO[bytes], content: bytes) -> tuple[int, int]:
    begin = pieces.tell()
    pieces.write(content)
    return begin, begin + len(content)


def _tree(nodes: list[_Node], depth: int) -> _Node | None:
    """Join the nodes level by level up to the root; None for a map without cells."""
    for _ in range(DEPTH - depth):
        groups: dict[Cube, dict[int, _Node]] = {}
        for node in nodes:
            x, y, z = node.cube
            place = (x & 1) | (y & 1) << 1 | (z & 1) << 2
            groups.setdefault((x >> 1, y >> 1, z >> 1), {})[place] = node
        nodes = []
        for cube, children in groups.items():
            ordered = dict(sorted(children.items()))
            branch = join_branches({place: node.branch for place, node in ordered.items()})
            nodes.append(_Node(cube, branch, ordered))
    return nodes[0] if nodes else None


def _write_node(file: IO[bytes], node: _Node, pieces: IO[bytes], *, binary: bool) -> None:
    """Write a node and all below it, depth first; a ``.bt`` stores leaves in their parents."""
    if binary and node.branch.kind != INNER:
        return
    file.write(node.branch.binary if binary else node.branch.full)
    begin, end = node.binary if binary else node.full
    pieces.seek(begin)
    file.write(pieces.read(end - begin))
    for child in node.children.values():
        _write_node(file, child, pieces, binary=binary)


@reader
def read_octomap(path: StrPath) -> OccupancyVoxels:
    """Read an ``.ot`` file; pruned leaves are expanded."""
    pieces = list(octomap_pieces(Path(path)))
    return join_voxels(pieces, pieces[0].resolution_m)


def octomap_pieces(path: Path, nodes_each: int = 1 << 19) -> Iterator[OccupancyVoxels]:
    """Read the cells of an ``.ot`` file in file order, in at least one piece."""
    with reading(path), path.open("rb") as file:
        left, resolution_m = _read_header(file)
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
                raise FormatError(_DAMAGED)
            yield found


def _cells(nodes: NDArray[np.void], walk: TreeWalk, resolution_m: float) -> OccupancyVoxels | None:
    """Return the cells of the next nodes; None if they do not fit the tree."""
    seen, leaves = find_leaves(np.ascontiguousarray(nodes["children"]), walk)
    log_odds = nodes["log_odds"][leaves.nodes]
    coarse = (leaves.levels < _COARSEST).any()
    if seen < len(nodes) or coarse or not np.isfinite(log_odds).all():
        return None
    cells = int((1 << 3 * (DEPTH - leaves.levels.astype(np.int64))).sum())
    if cells > max(_FEW_CELLS, _MOST_GROWTH * len(nodes)):
        what = "the OctoMap claims far more cells than it has nodes"
        raise FormatError(what, got=f"{cells} of {len(nodes)}")
    keys, leaf = [np.zeros((0, 3), np.int32)], [np.zeros(0, np.intp)]
    for level in np.unique(leaves.levels).tolist():
        edge = 1 << (DEPTH - level)
        which = np.flatnonzero(leaves.levels == level)
        inside = np.stack(np.unravel_index(np.arange(edge**3), (edge,) * 3), axis=1)
        corners = leaves.places[which].astype(np.int32) * edge - KEY_LIMIT
        keys.append((corners[:, None] + inside.astype(np.int32)).reshape(-1, 3))
        leaf.append(np.repeat(which, edge**3))
    return OccupancyVoxels(np.concatenate(keys), log_odds[np.concatenate(leaf)], resolution_m)


def _read_header(file: IO[bytes]) -> tuple[int, float]:
    first = file.readline(200).strip()
    if first != _FULL_TREE:
        raise FormatError("not an .ot OctoMap file", got=first[:40])
    fields: dict[bytes, bytes] = {}
    for _ in range(_LONGEST_HEADER_LINES):
        name, _, value = file.readline(200).strip().partition(b" ")
        if name == b"data":
            break
        fields[name] = value
    try:
        nodes, resolution_m = parse_integer(fields[b"size"]), parse_number(fields[b"res"])
    except (KeyError, ValueError) as error:
        raise FormatError(_DAMAGED) from error
    kind = fields.get(b"id", b"")
    if kind != b"OcTree" or nodes < 0 or not 0 < resolution_m < np.inf:
        raise FormatError("the file has no occupancy octree", got=kind[:40])
    return nodes, resolution_m


@dataclass(frozen=True)
class Branch:
    """A node with everything below it."""

    full: bytes  # its bytes in an ``.ot`` file
    binary: bytes  # its bytes in a ``.bt`` file; empty for a leaf, which is stored in its parent
    value: float  # its log-odds: the maximum of the leaves below it
    kind: int  # 1 = free, 2 = occupied, 3 = has children, in the pruned tree of the ``.bt``
    nodes: int  # number of nodes in the ``.ot``, including itself
    pruned_nodes: int  # number of nodes in the ``.bt``, including itself


def encode_branch(keys: Int32, log_odds: Float32, depth: int) -> Branch:
    """Encode the branch of a cube of cells (N, 3), N ≥ 1, distinct; log-odds from 0 = occupied."""
    cells, code = keys.astype(np.int64) & ((1 << depth) - 1), np.zeros(len(keys), np.int64)
    for bit in range(depth):
        for axis in range(3):
            code |= ((cells[:, axis] >> bit) & 1) << (3 * bit + axis)
    order = np.argsort(code)
    values, kinds = [log_odds[order]], [np.where(log_odds[order] >= 0, OCCUPIED, FREE)]
    codes, begins = [code[order]], []
    for _ in range(depth):
        parent = codes[-1] >> 3
        begin = np.flatnonzero(np.r_[True, parent[1:] != parent[:-1]])
        begins.append(begin)
        values.append(np.maximum.reduceat(values[-1], begin))
        # Eight equal leaves become a leaf; others have children.
        low = np.minimum.reduceat(kinds[-1], begin)
        high = np.maximum.reduceat(kinds[-1], begin)
        whole = np.diff(np.r_[begin, len(kinds[-1])]) == 8
        kinds.append(np.where(whole & (low == high) & (low != INNER), low, INNER))
        codes.append(parent[begin])
    full = _encode_full(codes, values, begins)
    binary, pruned_nodes = _encode_binary(codes, kinds, begins)
    value, kind = float(values[-1][0]), int(kinds[-1][0])
    return Branch(full, binary, value, kind, sum(map(len, codes)), pruned_nodes)


def join_branches(children: dict[int, Branch]) -> Branch:
    """Return the parent node of branches by index: bit 0 is x, bit 1 y, bit 2 z."""
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


def _encode_full(codes: list[_Index], values: list[Float32], begins: list[_Index]) -> bytes:
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
