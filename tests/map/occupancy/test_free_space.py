"""A vertex is in free space if cameras saw through it and nothing occupied is near."""

from __future__ import annotations

import numpy as np

from recon.core.values import OccupancyVoxels
from recon.map.occupancy.moving import looked_through

RESOLUTION_M = 0.2


def voxels(free: list[tuple[int, int, int]], taken: list[tuple[int, int, int]]) -> OccupancyVoxels:
    keys = np.array(free + taken, dtype=np.int32).reshape(-1, 3)
    log_odds = np.array([-1.0] * len(free) + [1.0] * len(taken), dtype=np.float32)
    return OccupancyVoxels(keys, log_odds, RESOLUTION_M)


def at(*cells: tuple[float, float, float]) -> np.ndarray:
    return (np.array(cells, dtype=np.float32) + 0.5) * np.float32(RESOLUTION_M)


def test_free_cells_far_from_anything_occupied_are_looked_through() -> None:
    seen = voxels([(0, 0, 0), (-7, 3, 2)], [(5, 5, 5)])
    assert looked_through(at((0, 0, 0), (-7, 3, 2)), seen).tolist() == [True, True]


def test_free_cells_beside_occupied_ones_are_not() -> None:
    seen = voxels([(0, 0, 0), (1, 1, 1), (2, 2, 2)], [(0, 1, 0)])
    found = looked_through(at((0, 0, 0), (1, 1, 1), (2, 2, 2)), seen)
    assert found.tolist() == [False, False, True]


def test_occupied_and_unknown_cells_are_not() -> None:
    seen = voxels([(0, 0, 0)], [(4, 4, 4)])
    assert looked_through(at((4, 4, 4), (9, 9, 9)), seen).tolist() == [False, False]


def test_without_voxels_or_vertices_nothing_is() -> None:
    assert looked_through(at((0, 0, 0)), voxels([], [])).tolist() == [False]
    assert looked_through(np.zeros((0, 3), np.float32), voxels([(0, 0, 0)], [])).tolist() == []
    only_free = voxels([(0, 0, 0)], [])
    assert looked_through(at((0, 0, 0)), only_free).tolist() == [True]
