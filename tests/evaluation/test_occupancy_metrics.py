"""Metrics of occupancy maps, on ground truth that can be counted by hand."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from recon.core.errors import EvaluationError
from recon.core.values import (
    FREE,
    OCCUPIED,
    UNKNOWN,
    OccupancyGrid,
    OccupancyTruth,
    OccupancyVoxels,
    RectifiedCamera,
)
from recon.evaluation.occupancy import evaluate_occupancy
from recon.map.ground.axes import AXES_MAP_WORLD

EDGE_M = 0.2
# Half as wide as far: sees 10 m to each side at 20 m.
CAMERA = RectifiedCamera(100.0, 49.5, 49.5, 49.5, 0.5, 100, 100)
WALL = np.array([(50, j, k) for j in range(-6, 6) for k in range(-3, 3)], np.int32)


def _truth(frames: int = 3, **changes: object) -> OccupancyTruth:
    """A wall 10 m ahead, in view of a camera that stands still; a grid with its footprint."""
    cells = np.full((20, 60), FREE, np.int8)
    cells[4:16, 50] = OCCUPIED
    pose = np.eye(4)
    pose[:3, :3] = AXES_MAP_WORLD
    truth = OccupancyTruth(
        grid=OccupancyGrid(cells, EDGE_M, (0.0, -2.0)),
        seen=np.ones(cells.shape, dtype=np.bool_),
        keys=WALL,
        frames=np.full(len(WALL), frames, np.int32),
        camera=CAMERA,
        T_map_camera=np.tile(pose, (frames, 1, 1)),
        range_m=20.0,
        least_frames=3,
    )
    return replace(truth, **changes)  # type: ignore[arg-type]


def _voxels(*keys: np.ndarray, free: np.ndarray | None = None) -> OccupancyVoxels:
    free = np.zeros((0, 3), np.int32) if free is None else free
    full = np.concatenate(keys)
    log_odds = np.concatenate([np.full(len(full), 2.0), np.full(len(free), -2.0)])
    return OccupancyVoxels(
        np.concatenate([full, free]).astype(np.int32), log_odds.astype(np.float32), EDGE_M
    )


def test_the_truth_itself_is_perfect() -> None:
    found = evaluate_occupancy(
        _voxels(WALL, free=WALL - np.array([5, 0, 0])), _truth().grid, _truth()
    )
    for voxels in (found.voxels, found.voxels_exact):
        assert (voxels.precision, voxels.recall) == (1.0, 1.0)
        assert (voxels.voxels, voxels.true_voxels) == (72, 72)
    for grid in (found.grid, found.grid_exact):
        assert (grid.iou_occupied, grid.iou_free, grid.unknown) == (1.0, 1.0, 0.0)
        assert (grid.cells, grid.true_occupied) == (1200, 12)


@pytest.mark.parametrize(("shift", "exact", "tolerant"), [(1, 0.0, 1.0), (2, 0.0, 0.0)])
def test_the_tolerance_is_one_cell(shift: int, exact: float, tolerant: float) -> None:
    truth = _truth()
    moved = OccupancyGrid(np.roll(truth.grid.cells, shift, axis=1), EDGE_M, (0.0, -2.0))
    found = evaluate_occupancy(_voxels(WALL + np.array([shift, 0, 0])), moved, truth)
    assert (found.voxels_exact.precision, found.voxels_exact.recall) == (exact, exact)
    assert (found.voxels.precision, found.voxels.recall) == (tolerant, tolerant)
    assert found.grid_exact.iou_occupied == exact
    assert found.grid.iou_occupied == tolerant


def test_voxels_that_no_image_held_do_not_count() -> None:
    beside, behind, far = (WALL + np.array(by) for by in ([0, 80, 0], [-100, 0, 0], [60, 0, 0]))
    found = evaluate_occupancy(_voxels(WALL, beside, behind, far), _truth().grid, _truth())
    assert (found.voxels.precision, found.voxels.voxels) == (1.0, 72)
    # What is invented behind a wall is wrong.
    found = evaluate_occupancy(_voxels(WALL, WALL + np.array([6, 0, 0])), _truth().grid, _truth())
    assert (found.voxels.precision, found.voxels.recall) == (0.5, 1.0)


def test_true_voxels_must_have_been_seen_often_enough() -> None:
    frames = np.where(WALL[:, 1] < 0, 3, 2).astype(np.int32)
    seldom = replace(_truth(), frames=frames)
    half = evaluate_occupancy(_voxels(WALL[WALL[:, 1] < 0]), _truth().grid, seldom)
    assert (half.voxels.true_voxels, half.voxels.recall) == (len(WALL) / 2, 1.0)
    # A surface that was seen once is a surface nevertheless.
    assert evaluate_occupancy(_voxels(WALL), _truth().grid, seldom).voxels.precision == 1.0


def test_intersection_over_union_on_paper() -> None:
    cells = np.full((20, 60), FREE, np.int8)
    cells[4:10, 50] = OCCUPIED  # 6 of 12 found
    cells[10:12, 50] = UNKNOWN  # 2 not known, so 4 are called free
    cells[4:10, 20] = OCCUPIED  # 6 invented
    found = evaluate_occupancy(_voxels(WALL), OccupancyGrid(cells, EDGE_M, (0.0, -2.0)), _truth())
    assert found.grid_exact.iou_occupied == pytest.approx(6 / 18)
    # Free in both: all but 12 true, 6 invented. In either: all but 12 true, and 4 called free.
    assert found.grid_exact.iou_free == pytest.approx((1200 - 18) / (1200 - 12 + 4))
    assert found.grid_exact.occupied_called_free == pytest.approx(4 / 12)
    assert found.grid_exact.unknown == pytest.approx(2 / 1200)
    # Within one cell, a seventh true cell is found.
    assert found.grid.iou_occupied == pytest.approx(7 / 18)


def test_only_seen_cells_of_the_grid_count_wherever_it_lies() -> None:
    truth = _truth()
    seen = np.zeros_like(truth.seen)
    seen[:, 40:60] = True
    part = OccupancyGrid(truth.grid.cells[:, 45:], EDGE_M, (9.0, -2.0))
    found = evaluate_occupancy(_voxels(WALL), part, replace(truth, seen=seen))
    assert found.grid_exact.iou_occupied == 1.0
    assert found.grid_exact.unknown == pytest.approx(5 / 20)
    assert found.grid_exact.cells == 400


def test_wrong_comparisons_are_refused() -> None:
    coarse = OccupancyGrid(np.zeros((2, 2), np.int8), 0.4, (0.0, 0.0))
    with pytest.raises(EvaluationError, match="different resolutions"):
        evaluate_occupancy(_voxels(WALL), coarse, _truth())
    with pytest.raises(EvaluationError, match="no surface was seen in enough frames"):
        evaluate_occupancy(_voxels(WALL), _truth().grid, _truth(frames=2))
