"""3D Tiles: a cloud in parts of growing detail, of which a page loads what a view needs."""

from __future__ import annotations

import json
import math
import struct
from collections import defaultdict
from collections.abc import Iterable
from pathlib import Path
from typing import Any, Final

import numpy as np

from recon.core.values import PointCloud, join_clouds
from recon.core.values.arrays import Float64
from recon.io.atomic import write_text, writing_to
from recon.io.models.las import NODE_CELLS, octree

_STEPS: Final = 1 << 30  # along a side of the cube: octrees are of whole numbers
_ERROR_CELLS: Final = 4  # by how many of its cells a node errs, without those below it
Node = tuple[int, ...]  # depth and cell
_ROOT: Final[Node] = (-1,)


def write_tiles3d(
    folder: Path,
    clouds: Iterable[PointCloud],
    low_m: Float64,
    side_m: float,
    square_m: float,
    spacing_m: float,
) -> int:
    """Write clouds as ``tileset.json`` and a file for each node; returns the number of points.

    The tileset is an octree with additive refinement: a node has the first of the points left in
    each of its cells, the deepest ones, whose cells are no larger than ``spacing_m``, have all.
    Each cloud is of a square of ``square_m`` in the plane; memory holds one, and the points of
    nodes that are wider. The corner ``low_m`` (3,) of the cube of all is one of squares, and its
    side theirs, doubled some times. Without a point, nothing is written.

    Raises:
        OutputError: A file cannot be written.

    Ref: OGC 22-025r4, "3D Tiles", with the point cloud tiles of version 1.0.
    """
    depths = 1 + max(0, math.ceil(math.log2(side_m / spacing_m / NODE_CELLS)))
    shared = defaultdict[Node, list[PointCloud]](list)
    tiles = defaultdict[Node, dict[str, Any]](dict)
    bounds: dict[Node, Any] = {_ROOT: np.inf}  # lowest corner, and the highest one negated

    def put(node: Node, cloud: PointCloud) -> None:
        with writing_to(path := folder / f"{'_'.join(map(str, node))}.pnts"):
            folder.mkdir(parents=True, exist_ok=True)
            path.write_bytes(_pnts(cloud))
        bounds[node] = np.stack([cloud.xyz.min(axis=0), -cloud.xyz.max(axis=0)]).astype(float)
        tiles[node] = {"content": {"uri": path.name}, "extras": {"points": len(cloud)}}

    for cloud in filter(len, clouds):
        steps = np.floor((cloud.xyz - low_m) * (_STEPS / side_m)).astype(np.int64)
        nodes, parts = octree(steps, _STEPS, depths)
        for node, rows in zip(map(tuple, nodes.tolist()), parts, strict=True):
            if side_m / 2 ** node[0] > square_m:
                shared[node].append(cloud.select(rows))
            else:
                put(node, cloud.select(rows))
    for node, several in shared.items():
        put(node, join_clouds(several))
    points: int = sum(one["extras"]["points"] for one in tiles.values())
    for node in sorted(bounds if points else (), reverse=True):  # the deepest come first
        tile, cell_m = tiles[node], side_m / NODE_CELLS / 2.0 ** node[0]
        low, high = bounds[node] * [[1], [-1]]
        box = np.vstack([(low + high) / 2, np.diag((high - low) / 2)])
        leaf, tile["boundingVolume"] = "children" not in tile, {"box": box.ravel().tolist()}
        tile["geometricError"] = 0.0 if leaf else _ERROR_CELLS * cell_m
        tile.setdefault("extras", {})["spacing_m"] = spacing_m if leaf else cell_m
        if node != _ROOT:
            above = (node[0] - 1, *(i >> 1 for i in node[1:])) if node[0] else _ROOT
            bounds[above] = np.minimum(bounds[above], bounds[node])
            tiles[above].setdefault("children", []).append(tile)
    if points:
        root, error_m = tiles[_ROOT] | {"refine": "ADD"}, tiles[_ROOT]["geometricError"]
        whole = {"asset": {"version": "1.0"}, "geometricError": error_m, "root": root}
        write_text(folder / "tileset.json", json.dumps(whole, allow_nan=False))
    return points


def _pnts(cloud: PointCloud) -> bytes:
    """Return the file of a cloud: positions and colours, then attributes that are numbers."""
    drawn = {"POSITION": cloud.xyz} | ({} if cloud.rgb is None else {"RGB": cloud.rgb})
    numbers = {each.name: one.astype(np.float32) for each, one in cloud.attributes if each.scale}
    parts: list[bytes] = []
    kind = {"componentType": "FLOAT", "type": "SCALAR"}
    for head, columns, about in (({"POINTS_LENGTH": len(cloud)}, drawn, {}), ({}, numbers, kind)):
        entries, content = dict[str, Any](head), b""
        for name, values in columns.items():
            entries[name] = {"byteOffset": len(content), **about}
            content += values.tobytes()
        text, start = json.dumps(entries).encode(), 28 + sum(map(len, parts))
        parts += [text + b" " * (-(start + len(text)) % 8), content + bytes(-len(content) % 8)]
    sizes = [*map(len, parts)]
    return struct.pack("<4s6I", b"pnts", 1, 28 + sum(sizes), *sizes) + b"".join(parts)
