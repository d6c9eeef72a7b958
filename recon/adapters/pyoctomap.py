"""OctoMap files through pyoctomap: a file in, arrays out.

OctoMap's voxel grid is the same as ours: voxel ``k`` spans ``[k, k + 1) · resolution`` (its own
keys are offset by 2^15), so nothing is resampled.
"""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
import pyoctomap
from numpy.typing import NDArray

from recon.errors import FormatError
from recon.structures.arrays import Float32, Int32


def decode_octomap(path: Path) -> tuple[Int32, Float32, float]:
    """Voxels, log-odds and resolution of a ``.bt`` file.

    Pruned leaves are expanded into the voxels that they cover.

    Raises:
        FormatError: The file is missing, damaged or not an OctoMap.
    """
    tree = _read_tree(path)
    leaves = [
        (*leaf.getCoordinate(), leaf.getSize(), leaf.current_node.getLogOdds())
        for leaf in tree.begin_leafs()
    ]
    table = np.array(leaves, dtype=np.float64).reshape(-1, 5)
    resolution = float(tree.getResolution())
    keys, source = _expand(table[:, :3], table[:, 3], resolution)
    return keys, table[source, 4].astype(np.float32), resolution


def _read_tree(path: Path) -> Any:
    """Read the tree of a file and check that it is complete."""
    first = _first_line(path)
    if first != b"# Octomap OcTree binary file":
        raise FormatError(
            "the file is not an OctoMap", where=path, got=first[:40], expected=".bt or .ot"
        )
    tree = pyoctomap.OcTree(0.1)
    if not tree.readBinary(str(path)):
        raise FormatError("the OctoMap is truncated or damaged", where=path)
    return tree


def _first_line(path: Path) -> bytes:
    try:
        with path.open("rb") as file:
            return file.readline(200).strip()
    except OSError as error:
        raise FormatError("cannot read the OctoMap", where=path) from error


def _expand(
    centres: NDArray[np.float64], sizes: NDArray[np.float64], resolution_m: float
) -> tuple[Int32, NDArray[np.intp]]:
    """Voxels of leaves of any size, and the index of the leaf of each."""
    edges = np.rint(sizes / resolution_m).astype(np.int64)
    corners = np.rint(centres / resolution_m - edges[:, None] / 2).astype(np.int64)
    keys, source = [np.zeros((0, 3), np.int64)], [np.zeros(0, np.intp)]
    for edge in np.unique(edges).tolist():
        which = np.flatnonzero(edges == edge)
        inside = np.stack(np.unravel_index(np.arange(edge**3), (edge,) * 3), axis=1)
        keys.append((corners[which][:, None] + inside).reshape(-1, 3))
        source.append(np.repeat(which, edge**3))
    return np.concatenate(keys).astype(np.int32), np.concatenate(source)
