"""The reference of `voxels`: the same sums with a dictionary, for reading and testing."""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import NDArray

Cell = tuple[int, int, int]


def cell_of(point: NDArray[Any], edge: float) -> Cell:
    """Return the cell that a point (3,) lies in."""
    i, j, k = np.floor(np.asarray(point) / edge).astype(int).tolist()
    return i, j, k


def sum_points_reference(
    frames: list[tuple[NDArray[Any], NDArray[Any], NDArray[Any]]], edge: float
) -> dict[Cell, dict[str, Any]]:
    """Sum frames of points up per voxel.

    Args:
        frames: For each frame: xyz (N, 3), weights (N,), values (N, C).
        edge: Edge of a voxel.

    Returns:
        For each voxel, in the order first seen: ``sums`` float64 (4 + C,), ``information`` and
        ``frames`` as `recon.core.kernels.voxels.VoxelSums` defines them.
    """
    voxels: dict[Cell, dict[str, Any]] = {}
    for xyz, weights, values in frames:
        best: dict[Cell, float] = {}
        for point, w, value in zip(xyz, weights, values, strict=True):
            if not w > 0:
                continue
            cell = cell_of(point, edge)
            empty = {"sums": np.zeros(4 + len(value)), "information": 0.0, "frames": 0}
            voxel = voxels.setdefault(cell, empty)
            offset = point - (np.array(cell) + 0.5) * edge
            voxel["sums"] += w * np.concatenate([[1.0], offset, value])
            best[cell] = max(best.get(cell, 0.0), float(w))
        for cell, weight in best.items():
            voxels[cell]["information"] += weight
            voxels[cell]["frames"] += 1
    return voxels
