"""Clouds and voxels joined from pieces, cut to windows, and as trees for a store."""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import fields
from itertools import product
from typing import Any

import numpy as np
from numpy.typing import NDArray

from recon.core.kernels.voxels import pack_keys, unpack_keys
from recon.core.values import Frame, OccupancyVoxels, PointCloud
from recon.core.values.arrays import Bool
from recon.map.window import Window


def join_clouds(clouds: Iterable[PointCloud], frame: Frame = "map") -> PointCloud:
    """Concatenate clouds of one frame; attributes that one with points lacks are dropped."""
    parts = [cloud for cloud in clouds if len(cloud)]
    if not parts:
        return PointCloud(np.zeros((0, 3), np.float32), frame=frame)
    names = [field.name for field in fields(PointCloud) if field.name != "frame"]
    columns = {name: [getattr(cloud, name) for cloud in parts] for name in names}
    shared = {
        name: np.concatenate(arrays)
        for name, arrays in columns.items()
        if all(array is not None for array in arrays)
    }
    return PointCloud(**shared, frame=frame)


def join_voxels(parts: Iterable[OccupancyVoxels], resolution_m: float) -> OccupancyVoxels:
    """Concatenate voxels of one resolution; none is in two parts."""
    keys, log_odds = [np.zeros((0, 3), np.int32)], [np.zeros(0, np.float32)]
    for part in parts:
        keys.append(part.keys)
        log_odds.append(part.log_odds)
    return OccupancyVoxels(np.concatenate(keys), np.concatenate(log_odds), resolution_m)


def in_window(voxels: OccupancyVoxels, window: Window) -> OccupancyVoxels:
    """Return the voxels with their centres in a window."""
    low, high = (
        np.ceil(np.array(xy) / voxels.resolution_m - 0.5) for xy in (window.low, window.high)
    )
    x, y = voxels.keys[:, 0], voxels.keys[:, 1]
    inside: Bool = (x >= low[0]) & (x < high[0]) & (y >= low[1]) & (y < high[1])
    return voxels.select(inside)


def cloud_tree(cloud: PointCloud) -> dict[str, Any]:
    """Return the arrays of a cloud by their names."""
    arrays = {f.name: getattr(cloud, f.name) for f in fields(cloud) if f.name != "frame"}
    return {name: array for name, array in arrays.items() if array is not None}


def voxel_tree(voxels: OccupancyVoxels) -> dict[str, Any]:
    """Return the arrays of voxels by their names."""
    return {"keys": voxels.keys, "log_odds": voxels.log_odds}


def grown_blocks(blocks: NDArray[np.int64], by: int) -> NDArray[np.int64]:
    """Return packed blocks with those up to ``by`` blocks away from one on each axis."""
    steps = np.array(list(product(range(-by, by + 1), repeat=3)))
    around = unpack_keys(blocks)[:, None] + steps
    return np.unique(pack_keys(around.reshape(-1, 3)))
