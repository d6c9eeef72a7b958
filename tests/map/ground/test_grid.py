"""Flattening: obstacles stand above the local ground, and unknown stays unknown."""

from __future__ import annotations

import numpy as np
import pytest

from recon.core.errors import MappingError
from recon.core.values import FREE, OCCUPIED, UNKNOWN, OccupancyGrid, OccupancyVoxels
from recon.map.ground import grid as grid_file
from recon.map.ground.grid import GridSettings, drop_undecided, flatten, ground_depths
from recon.map.ground.surface import GroundSurface

SLOPE = 0.1


def _ground(slope: float = 0.0, x0: float = -2.0, columns: int = 30) -> GroundSurface:
    """z = slope · x - 1.6 on cells of 1 m from (x0, -5)."""
    x = x0 + np.arange(columns) + 0.5
    return GroundSurface(np.tile(slope * x - 1.6, (10, 1)), 1.0, (x0, -5.0))


def _voxels(*parts: tuple[np.ndarray, float]) -> OccupancyVoxels:
    keys = np.vstack([np.asarray(cells).reshape(-1, 3) for cells, _ in parts]).astype(np.int32)
    log_odds = np.concatenate([np.full(len(cells), value) for cells, value in parts])
    return OccupancyVoxels(keys, log_odds.astype(np.float32), 0.2)


def _box(low: tuple[float, ...], high: tuple[float, ...]) -> np.ndarray:
    """Cells whose centres lie in a box, metres."""
    ranges = [np.arange(round(a / 0.2), round(b / 0.2)) for a, b in zip(low, high, strict=True)]
    return np.stack(np.meshgrid(*ranges, indexing="ij"), axis=-1).reshape(-1, 3)


def _road(low: tuple[float, float], high: tuple[float, float]) -> tuple[tuple, tuple]:
    """Ground at -1.6 m that was seen, and the free space that it was seen through."""
    ground, air = (_box((*low, z), (*high, z + 0.2)) for z in (-1.6, -1.2))
    return (ground, 2.0), (air, -1.0)


def _cell(grid: OccupancyGrid, x: float, y: float) -> int:
    column = int((x - grid.origin_m[0]) / grid.resolution_m)
    row = int((y - grid.origin_m[1]) / grid.resolution_m)
    return int(grid.cells[row, column])


def _flatten(voxels: OccupancyVoxels, ground: GroundSurface, **settings: float) -> OccupancyGrid:
    return flatten(voxels, ground, GridSettings(**settings))


def _slanted_scene() -> OccupancyVoxels:
    """Ground that rises by 10 %, over 20 m, and a box 1 m high on it at x = 15, y = 2."""
    columns = _box((0, -4, 0), (20, 4, 0.2))
    columns[:, 2] = np.floor((SLOPE * (columns[:, 0] + 0.5) * 0.2 - 1.6) / 0.2)
    box = _box((15, 2, -0.1), (16, 3, 0.9))
    return _voxels((columns, 2.0), (columns + np.array([0, 0, 2]), -1.0), (box, 2.0))


def test_a_box_on_slanted_ground_is_occupied_and_the_ground_is_not() -> None:
    grid = _flatten(_slanted_scene(), _ground(SLOPE))
    assert _cell(grid, 15.5, 2.5) == OCCUPIED
    assert (grid.cells == OCCUPIED).sum() == 25
    assert (grid.cells == FREE).sum() == grid.cells.size - 25
    # A level band would call the slope an obstacle.
    assert _cell(_flatten(_slanted_scene(), _ground(0.0)), 19.0, -3.0) == OCCUPIED


def test_the_grid_is_the_right_way_round() -> None:
    # One obstacle at x = 3, y = -1: row 0 has the smallest y.
    grid = _flatten(
        _voxels(*_road((0, -2), (4, 2)), (_box((3, -1, -1), (3.6, -0.4, 0)), 2.0)), _ground()
    )
    assert grid.origin_m == pytest.approx((0.0, -2.0))
    assert grid.cells.shape == (20, 20)
    rows, columns = np.nonzero(grid.cells == OCCUPIED)
    assert (rows.min(), rows.max()) == (5, 7)
    assert (columns.min(), columns.max()) == (15, 17)


def test_unknown_stays_unknown() -> None:
    seen = _road((0, 0), (2, 4))
    above = (_box((2, 0, 0.0), (4, 4, 0.2)), -1.0)
    undecided = (_box((4, 0, -1.0), (5, 4, -0.6)), 0.1)
    grid = _flatten(_voxels(*seen, above, undecided), _ground())
    assert _cell(grid, 1.0, 2.0) == FREE
    # Free only at 1.6 m above ground, as behind a parked car that is looked over.
    assert _cell(grid, 3.0, 2.0) == UNKNOWN
    assert _cell(grid, 4.5, 2.0) == UNKNOWN
    assert (grid.cells != OCCUPIED).all()
    # A parked car whose sides gave no match: the road below it is seen, nothing above it.
    below = (_box((2, 0, -1.6), (4, 2, -1.4)), 2.0)
    over = (_box((2, 0, 0.0), (4, 2, 0.4)), -2.0)
    assert (
        _cell(_flatten(_voxels(*_road((0, 0), (2, 2)), below, over), _ground()), 3.0, 1.0)
        == UNKNOWN
    )
    # Where no ground is known, even what is full is unknown.
    far = _voxels((_box((100, 0, -1.6), (104, 4, 1.0)), 2.0))
    assert (_flatten(far, _ground()).cells == UNKNOWN).all()
    low = _voxels((_box((0, 0, -1.0), (4, 4, -0.8)), -1.0))
    assert (_flatten(low, _ground()).cells == FREE).all()


@pytest.mark.parametrize(
    ("low", "high", "setting", "cells"),
    [
        ((1, 0, 1.0), (2, 4, 1.4), {"max_height_m": 3.0}, 100),  # a bridge above the band
        ((1, 1, -1), (1.2, 1.4, -0.6), {"min_blob_cells": 1}, 2),  # a speck
    ],
)
def test_what_is_driven_under_or_taken_for_noise_is_a_setting(
    low: tuple, high: tuple, setting: dict[str, float], cells: int
) -> None:
    voxels = _voxels(*_road((0, 0), (4, 4)), (_box(low, high), 2.0))
    assert (_flatten(voxels, _ground()).cells == FREE).all()
    assert (_flatten(voxels, _ground(), **setting).cells == OCCUPIED).sum() == cells


def test_what_was_hit_behind_a_wall_belongs_to_it(monkeypatch: pytest.MonkeyPatch) -> None:
    # The wall at x = 2 is sure; behind it the hits of an uncertain depth, then nothing.
    wall = (_box((2, 0, -1.0), (2.2, 4, -0.6)), 2.0)
    behind = (_box((2.2, 0, -1.0), (3.4, 4, -0.6)), 0.01)
    voxels = _voxels(*_road((0, 0), (2, 4)), wall, behind)
    cells = []
    for joined in (0, 1, 2):
        monkeypatch.setattr(grid_file, "JOINED_CELLS", joined)
        cells.append(_cell(_flatten(voxels, _ground()), 2.5, 2.0))
    assert cells == [UNKNOWN, UNKNOWN, OCCUPIED]
    # It goes on for so many cells, and no farther.
    monkeypatch.setattr(grid_file, "JOINED_CELLS", 3)
    assert (_flatten(voxels, _ground()).cells[10] == OCCUPIED).sum() == 4


def test_what_was_hit_before_a_wall_does_not_make_it_thicker() -> None:
    wall = (_box((2.4, 0, -1.0), (2.6, 4, -0.6)), 2.0)
    before = (_box((2.0, 0, -1.0), (2.4, 4, -0.6)), 0.01)
    grid = _flatten(_voxels(*_road((0, 0), (2, 4)), wall, before), _ground())
    # The cell beside the free road may hold nothing; the next one touches no free cell.
    row = grid.cells[10]
    assert row[9:13].tolist() == [FREE, UNKNOWN, OCCUPIED, OCCUPIED]
    free = (_box((2.0, 0, -1.0), (2.4, 4, -0.8)), -1.0)
    grid = _flatten(_voxels(*_road((0, 0), (2, 4)), wall, free), _ground())
    assert grid.cells[10, 9:13].tolist() == [FREE, FREE, FREE, OCCUPIED]


def test_a_cell_beside_an_obstacle_that_was_hit_low_is_not_free() -> None:
    wall = (_box((2.4, 0, -1.0), (2.6, 4, -0.6)), 2.0)
    low, high = ((_box((2.0, 0, z), (2.4, 4, z + 0.2)), 0.1) for z in (-1.0, -0.4))
    road = _road((0, 0), (2.4, 4))
    grids = [_flatten(_voxels(*road, wall, hit), _ground()) for hit in (low, high)]
    assert [grid.cells[10, 9:13].tolist() for grid in grids] == [
        [FREE, FREE, UNKNOWN, OCCUPIED],
        [FREE, FREE, FREE, OCCUPIED],
    ]


def test_undecided_voxels_are_dropped() -> None:
    voxels = OccupancyVoxels(
        np.arange(15, dtype=np.int32).reshape(5, 3),
        np.array([2.0, 0.3, 0.1, -0.4, -0.8], np.float32),
        0.2,
    )
    # 0.55 and 0.35 are log-odds of 0.20 and -0.62: one look is not enough for free.
    kept = drop_undecided(voxels)
    assert kept.log_odds.tolist() == pytest.approx([2.0, 0.3, -0.8])
    assert kept.keys[:, 0].tolist() == [0, 3, 12]


def test_impossible_requests_are_refused() -> None:
    with pytest.raises(MappingError, match="nothing was observed"):
        _flatten(_voxels((np.zeros((0, 3)), 0.0)), _ground())
    with pytest.raises(MappingError, match="band of the grid is empty"):
        _flatten(_slanted_scene(), _ground(), min_height_m=2.0, max_height_m=1.0)


def test_the_ground_is_as_thick_as_what_is_seen_below_it_but_not_as_deep_as_a_hole() -> None:
    road = _box((0, -2, -1.6), (4, 2, -1.4)), 2.0
    low, hole = ((_box((0, -2, z), (4, 0, z + 0.2)), 2.0) for z in (-1.8, -2.4))
    unsure = _box((0, -2, -2.0), (4, 2, -1.8)), 0.05
    depths_m = ground_depths(_voxels(road, low, hole, unsure), _ground())
    np.testing.assert_allclose(depths_m, np.full(200, 0.1), atol=1e-6)
