"""Accuracy and completeness of an occupancy map with respect to exact ground truth.

Only what enough frames could observe counts: true voxels whose surface they saw, occupied voxels
that they had in view and in range, occluded or not, and cells in which they saw a surface.
"""

from __future__ import annotations

from typing import Final

import cv2
import numpy as np
from numpy.typing import NDArray

from recon.core.errors import EvaluationError
from recon.core.geometry import se3
from recon.core.kernels.voxels import find_keys, pack_keys
from recon.core.text import counted
from recon.core.values import (
    FREE,
    OCCUPIED,
    UNKNOWN,
    GridMetrics,
    OccupancyGrid,
    OccupancyMetrics,
    OccupancyTruth,
    OccupancyVoxels,
    VoxelMetrics,
)
from recon.core.values.arrays import Bool, Int32
from recon.core.values.camera import project

_TOLERANCE: Final = 1


def evaluate_occupancy(
    voxels: OccupancyVoxels, grid: OccupancyGrid, truth: OccupancyTruth
) -> OccupancyMetrics:
    """Compare the voxels and the 2-D grid of a map with the truth in its axes and cells.

    Results are with a tolerance of one cell (26 neighbours in 3-D, 8 in the grid), and without: an
    estimated cell is wrong if no true one of its state is that near, a true one found if an
    estimated one is. IoU = found / (true + wrong). Log-odds above 0 are occupied.
    """
    _check(voxels, grid, truth)
    occupied = voxels.keys[voxels.log_odds > 0]
    counted, cells = occupied[_looked_at(occupied, truth)], grid_on_truth(grid, truth)
    return OccupancyMetrics(
        resolution_m=voxels.resolution_m,
        least_frames=truth.least_frames,
        voxels=_compare_voxels(occupied, counted, truth, _TOLERANCE),
        voxels_exact=_compare_voxels(occupied, counted, truth, 0),
        grid=_compare_grids(cells, truth, _TOLERANCE),
        grid_exact=_compare_grids(cells, truth, 0),
    )


def _check(voxels: OccupancyVoxels, grid: OccupancyGrid, truth: OccupancyTruth) -> None:
    sizes = {voxels.resolution_m, grid.resolution_m, truth.grid.resolution_m}
    if max(sizes) - min(sizes) > 1e-9:
        got = ", ".join(f"{size:g} m" for size in sorted(sizes))
        raise EvaluationError("map and truth have different resolutions", got=got)
    if not (truth.frames >= truth.least_frames).any() or not truth.seen.any():
        what = "no surface was seen in enough frames to compare"
        expected = f"surfaces seen in {counted(truth.least_frames, 'frame')}"
        raise EvaluationError(what, expected=expected, hint="use a drive with more frames")


def _looked_at(keys: Int32, truth: OccupancyTruth) -> Bool:
    centres = (keys.astype(np.float64) + 0.5) * truth.grid.resolution_m
    frames = np.zeros(len(keys), np.int64)
    width, height = truth.camera.width_px, truth.camera.height_px
    for T_map_camera in truth.T_map_camera:
        xyz = se3.apply(se3.invert(T_map_camera), centres)
        place = np.flatnonzero((xyz[:, 2] > 0) & (np.linalg.norm(xyz, axis=1) <= truth.range_m))
        u, v, _ = project(xyz[place], truth.camera)
        inside = (u >= -0.5) & (u < width - 0.5) & (v >= -0.5) & (v < height - 0.5)
        frames[place[inside]] += 1
    return np.asarray(frames >= truth.least_frames)


def _compare_voxels(
    occupied: Int32, counted: Int32, truth: OccupancyTruth, tolerance: int
) -> VoxelMetrics:
    wanted = truth.keys[truth.frames >= truth.least_frames]
    return VoxelMetrics(
        precision=_ratio(_near(counted, truth.keys, tolerance)),
        recall=_ratio(_near(wanted, occupied, tolerance)),
        voxels=len(counted),
        true_voxels=len(wanted),
    )


def _near(keys: Int32, others: Int32, tolerance: int) -> Bool:
    """Return which voxels have one of the others within ``tolerance`` cells on every axis."""
    steps = np.arange(-tolerance, tolerance + 1)
    known = np.sort(pack_keys(others))
    found = np.zeros(len(keys), dtype=np.bool_)
    for offset in np.stack(np.meshgrid(steps, steps, steps), axis=-1).reshape(-1, 3):
        found |= find_keys(pack_keys(keys + offset), known)[1]
    return found


def grid_on_truth(grid: OccupancyGrid, truth: OccupancyTruth) -> NDArray[np.int8]:
    """Return the cells of a grid, cropped or padded with UNKNOWN to the extent of the true grid."""
    offset_m = np.array(truth.grid.origin_m) - np.array(grid.origin_m)
    right, down = np.rint(offset_m / grid.resolution_m).astype(int).tolist()
    rows, columns = (np.arange(n) for n in truth.seen.shape)
    rows = rows[(rows + down >= 0) & (rows + down < grid.cells.shape[0])]
    columns = columns[(columns + right >= 0) & (columns + right < grid.cells.shape[1])]
    cells = np.full(truth.seen.shape, UNKNOWN, np.int8)
    cells[np.ix_(rows, columns)] = grid.cells[np.ix_(rows + down, columns + right)]
    return cells


def _compare_grids(cells: NDArray[np.int8], truth: OccupancyTruth, tolerance: int) -> GridMetrics:
    true, seen = truth.grid.cells, truth.seen
    occupied = seen & (true == OCCUPIED)
    return GridMetrics(
        iou_occupied=_iou(cells == OCCUPIED, true == OCCUPIED, seen, tolerance),
        iou_free=_iou(cells == FREE, true == FREE, seen, tolerance),
        occupied_called_free=_ratio(cells[occupied] == FREE),
        unknown=_ratio(cells[seen] == UNKNOWN),
        cells=int(seen.sum()),
        true_occupied=int(occupied.sum()),
    )


def _iou(estimate: Bool, true: Bool, seen: Bool, tolerance: int) -> float:
    """Return found / (true + wrong) of seen cells; without tolerance, intersection over union."""
    found = seen & true & _grown(estimate, tolerance)
    wrong = seen & estimate & ~_grown(true, tolerance)
    union = int((seen & true).sum() + wrong.sum())
    return float(found.sum() / union) if union else float("nan")


def _grown(cells: Bool, tolerance: int) -> Bool:
    kernel = np.ones((2 * tolerance + 1, 2 * tolerance + 1), np.uint8)
    return np.asarray(cv2.dilate(cells.astype(np.uint8), kernel) > 0)


def _ratio(which: Bool) -> float:
    """Return the fraction of True values; NaN if empty."""
    return float(which.mean()) if which.size else float("nan")
