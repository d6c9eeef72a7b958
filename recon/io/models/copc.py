"""Point clouds as COPC files (extra ``survey``): LAZ in an octree, read as far as a view needs it.

Ref: https://copc.io, version 1.0.
"""

from __future__ import annotations

import struct
from collections.abc import Iterable
from os import SEEK_END
from typing import Final

import numpy as np

from recon.core.errors import require
from recon.core.kernels.voxels import KEY_BITS, pack_keys
from recon.core.values import PointCloud
from recon.core.values.arrays import Float64, Int64
from recon.io.files import StrPath
from recon.io.models.columns import with_first
from recon.io.models.las import COLOURED, AreGround, las_header, las_record, packing

_EXTRA: Final = "survey"
_CELL_BITS: Final = 7  # a node has 128 cells along each side, with a point for each
_INFO: Final = struct.Struct("<5d2Q2d88x")  # the first record of the file
_INFO_AT: Final = 375 + 54  # behind the header of LAS 1.4 and that of the record
_LONG: Final = struct.Struct("<2x16sHQ32s")  # the header of a record behind the points
_ENTRY: Final = np.dtype(
    [("node", "<i4", 4), ("offset", "<u8"), ("bytes", "<i4"), ("points", "<i4")]
)


def write_copc(
    path: StrPath,
    clouds: Iterable[PointCloud],
    T_to_from: Float64,
    crs: str | None = None,
    *,
    step_m: float,
    ground: AreGround | None = None,
) -> int:
    """Write clouds into one COPC file, atomically, as `write_las` does; returns their points.

    All points are in memory at once.
    """
    laspy, lazrs = require("laspy", extra=_EXTRA), require("lazrs", extra=_EXTRA)
    first, clouds = with_first(clouds)
    header = las_header(laspy, first, T_to_from, crs, step_m)
    records = [las_record(laspy, header, cloud, T_to_from, ground) for cloud in clouds]
    points = laspy.ScaleAwarePointRecord.empty(header=header)
    points.array = np.concatenate([points.array, *(one.array for one in records)])
    steps = np.stack([points.array[axis] for axis in "XYZ"], axis=1).astype(np.int64)
    low, high = (steps.min(axis=0), steps.max(axis=0)) if len(steps) else np.zeros((2, 3), int)
    # The cube is no larger than its longest side: there are readers that take that for granted.
    side = max(1, int((high - low).max()))
    nodes = _octree(steps - low, side)
    order = np.lexsort(nodes.T[::-1])
    nodes = nodes[order]
    begins = np.flatnonzero(np.diff(nodes, axis=0, prepend=-1).any(axis=1))
    chunks = np.split(points.array[order], begins[1:])

    packed = lazrs.LazVlr.new_for_compression(COLOURED, points.point_format.num_extra_bytes, True)
    info = laspy.VLR("copc", 1, "", bytes(_INFO.size))
    header.update(points)
    header.vlrs[:0] = [info, laspy.vlrs.known.LasZipVlr(packed.record_data())]
    header.are_points_compressed, header.number_of_evlrs = True, 1
    with packing(path) as temporary, temporary.open("w+b") as file:
        header.write_to(file)
        packer = lazrs.ParLasZipCompressor(file, packed)
        packer.compress_chunks([np.frombuffer(chunk, np.uint8) for chunk in chunks])
        packer.done()
        header.start_of_first_evlr = file.seek(0, SEEK_END)
        file.seek(header.offset_to_point_data)
        entries = np.zeros(len(begins), _ENTRY)
        entries["points"], entries["bytes"] = np.array(lazrs.read_chunk_table(file, packed)).T
        # A chunk begins where those before it end, the first behind where their table is.
        ends = header.offset_to_point_data + 8 + np.cumsum(entries["bytes"])
        entries["node"], entries["offset"] = nodes[begins], ends - entries["bytes"]
        file.seek(header.start_of_first_evlr)
        file.write(_LONG.pack(b"copc", 1000, entries.nbytes, b"") + entries.tobytes())
        file.seek(0)
        header.write_to(file, ensure_same_size=True)
        half_m, hierarchy_at = step_m * side / 2, header.start_of_first_evlr + _LONG.size
        cube = *(header.offsets + step_m * low + half_m), half_m, 2 * half_m / (1 << _CELL_BITS)
        file.seek(_INFO_AT)
        file.write(_INFO.pack(*cube, hierarchy_at, entries.nbytes, 0.0, 0.0))
    return len(points)


def _octree(steps: Int64, side: int) -> Int64:
    """Return the node (N, 4), depth and cell, of each point (N, 3) in a cube, all in steps.

    A node has the first of the points left in each of its cells, the deepest ones all.
    """
    nodes, left = np.zeros((len(steps), 4), np.int64), np.arange(len(steps))
    for depth in range(KEY_BITS - _CELL_BITS):
        bits = depth + _CELL_BITS
        cells = np.minimum((steps[left] << bits) // side, (1 << bits) - 1)
        nodes[left, 0], nodes[left, 1:] = depth, cells >> _CELL_BITS
        _, first = np.unique(pack_keys(cells), return_index=True)
        left = np.delete(left, first)
    return nodes
