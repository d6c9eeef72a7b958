"""OctoMap files: ``.ot`` with log-odds, ``.bt`` with only occupied and free."""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass, field, replace
from pathlib import Path
from tempfile import TemporaryFile
from typing import IO

import numpy as np

from recon.core.errors import MappingError
from recon.core.kernels.voxels import pack_keys
from recon.core.values import OccupancyVoxels
from recon.core.values.arrays import Int32
from recon.io.atomic import atomic_path
from recon.io.files import StrPath, reader
from recon.io.occupancy.octomap_leaves import octomap_pieces
from recon.io.occupancy.octree import (
    DEPTH,
    INNER,
    KEY_LIMIT,
    Branch,
    encode_branch,
    file_header,
    join_branches,
)

Cube = tuple[int, int, int]


def write_octomap_tiles(
    path: StrPath, tiles: Iterable[OccupancyVoxels], depth: int, resolution_m: float
) -> tuple[Path, Path]:
    """Write both files from tiles of a map, with one tile in memory at a time.

    Args:
        path: The common path without suffix.
        tiles: Tiles of the map; every cube with a side of ``2^depth`` cells lies in one tile.
        depth: Tree depth of these cubes, 1 to 15.
        resolution_m: Cell size.

    Returns:
        The two paths written: ``.bt``, ``.ot``.

    Raises:
        MappingError: The map is too large for an OctoMap.
        OutputError: A file cannot be written.
    """
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
                _write_tree(file, root, pieces, resolution_m, binary=is_binary)
    return binary, full


@dataclass
class _Node:
    """A node of the tree above the cubes, or the root of a cube.

    Attributes:
        cube: Its index among the cubes of its size.
        branch: Its branch; the bytes are those of the node alone, or empty for a cube, whose
            bytes are in the temporary file.
        children: Child nodes, by their index 0 to 7.
        full: Start and end of the bytes of a cube in the temporary file, for the ``.ot``.
        binary: The same, for the ``.bt``.
    """

    cube: Cube
    branch: Branch
    children: dict[int, _Node] = field(default_factory=dict)
    full: tuple[int, int] = (0, 0)
    binary: tuple[int, int] = (0, 0)


def _nodes(voxels: OccupancyVoxels, depth: int, pieces: IO[bytes]) -> list[_Node]:
    """Return nodes for the cubes of a tile; their bytes are appended to ``pieces``."""
    _check(voxels)
    if len(voxels) == 0:
        return []
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


def _write_tree(
    file: IO[bytes], root: _Node | None, pieces: IO[bytes], resolution_m: float, *, binary: bool
) -> None:
    if root is None:
        file.write(file_header(binary=binary, nodes=0, resolution_m=resolution_m))
        return
    nodes = root.branch.pruned_nodes if binary else root.branch.nodes
    file.write(file_header(binary=binary, nodes=nodes, resolution_m=resolution_m))
    _write_node(file, root, pieces, binary=binary)


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


def _check(voxels: OccupancyVoxels) -> None:
    keys: Int32 = voxels.keys
    if len(keys) and (keys.min() < -KEY_LIMIT or keys.max() >= KEY_LIMIT):
        raise MappingError(
            "the map is too large for an OctoMap of this resolution",
            got=f"{np.abs(keys).max() * voxels.resolution_m:.0f} m from the origin",
            expected=f"at most {KEY_LIMIT * voxels.resolution_m:.0f} m",
        )


@reader
def read_octomap(path: StrPath) -> OccupancyVoxels:
    """Read an ``.ot`` file; pruned leaves are expanded.

    Raises:
        FormatError: The file is missing, damaged or not an ``.ot`` file.
    """
    pieces = list(octomap_pieces(Path(path)))
    return OccupancyVoxels(
        np.concatenate([piece.keys for piece in pieces]),
        np.concatenate([piece.log_odds for piece in pieces]),
        pieces[0].resolution_m,
    )
