"""Voxels give the ground height beyond the fused cloud, and walls are not ground."""

from __future__ import annotations

import numpy as np
import pytest

from recon.core.values import OccupancyVoxels, PointCloud
from recon.map.ground import surface as ground
from recon.map.ground.surface import (
    GroundSettings,
    add_floors,
    estimate_ground_surface,
    find_floors,
)

EDGE_M = 0.2
SETTINGS = GroundSettings()


def _columns(x: range, y: range, heights: dict[int, float]) -> tuple[np.ndarray, np.ndarray]:
    """Voxels with log-odds by height, the same in every column."""
    keys = [(i, j, k) for i in x for j in y for k in heights]
    return np.array(keys, np.int32), np.tile(list(heights.values()), len(x) * len(y))


def _voxels(*parts: tuple[np.ndarray, np.ndarray]) -> OccupancyVoxels:
    keys, values = (np.concatenate(p) for p in zip(*parts, strict=True))
    return OccupancyVoxels(keys, values.astype(np.float32), EDGE_M)


def _empty(normals: bool = True) -> PointCloud:
    none = np.zeros((0, 3), np.float32)
    return PointCloud(none, normals=none if normals else None, frame="map")


ROAD = _columns(range(20), range(5), {-8: 2.0, -7: -1.0, -6: -1.0})
WALL = _columns(range(20), range(5, 6), dict.fromkeys(range(-8, 4), 2.0))


def test_floors_are_occupied_voxels_below_free_ones() -> None:
    added = add_floors(_empty(), find_floors(_voxels(ROAD, WALL)))
    assert len(added) == 100
    assert added.xyz[:, 2] == pytest.approx(-7.5 * EDGE_M)
    assert added.xyz[:, 1].max() < 1.0
    assert added.normals is not None
    assert (added.normals == [0, 0, 1]).all()


def test_a_floor_may_share_its_evidence_with_the_voxel_above() -> None:
    undecided = _columns(range(5), range(5), {-8: 2.0, -7: 0.1, -6: -1.0})
    thick = _columns(range(10, 15), range(5), {-8: 2.0, -7: 2.0, -6: -1.0})
    unknown = _columns(range(20, 25), range(5), {-8: 2.0})
    added = add_floors(_empty(), find_floors(_voxels(undecided, thick, unknown)))
    heights = {x0: added.xyz[np.floor(added.xyz[:, 0]) == x0, 2] for x0 in (0, 2, 4)}
    assert heights[0] == pytest.approx(-7.5 * EDGE_M)
    assert heights[2] == pytest.approx(-6.5 * EDGE_M)
    assert len(heights[4]) == 0


def test_cells_that_the_cloud_measures_are_left_to_it() -> None:
    rng = np.random.default_rng(0)
    xyz = np.column_stack([rng.uniform(0, 2, 200), rng.uniform(0, 1, 200), np.full(200, -1.62)])
    up = np.tile(np.array([0, 0, 1], np.float32), (200, 1))
    cloud = PointCloud(xyz.astype(np.float32), normals=up, frame="map")
    added = add_floors(cloud, find_floors(_voxels(ROAD)))
    assert added.xyz[200:, 0].min() > 2.0
    # Points on a wall measure no ground.
    sideways = PointCloud(cloud.xyz, normals=up[:, [2, 0, 1]], frame="map")
    assert add_floors(sideways, find_floors(_voxels(ROAD))).xyz[200:, 0].min() < 1.0


def test_the_ground_reaches_as_far_as_the_voxels(monkeypatch: pytest.MonkeyPatch) -> None:
    path = np.array([[0.5, 0.5, 0.0], [2.0, 0.5, 0.0]])
    long = _columns(range(100), range(-5, 10), {-8: 2.0, -7: -1.0})
    near = np.column_stack([np.random.default_rng(1).uniform(0, 2, (300, 2)), np.full(300, -1.5)])
    cloud = PointCloud(near.astype(np.float32), frame="map")
    place = np.array([[18.0, 0.5]])
    monkeypatch.setattr(ground, "_MAX_GAP_M", 2.0)
    settings = GroundSettings()
    assert np.isnan(estimate_ground_surface(cloud, path, settings).height_at(place)).all()
    floor = add_floors(cloud, find_floors(_voxels(long)))
    height = estimate_ground_surface(floor, path, settings).height_at(place)
    assert height == pytest.approx(-7.5 * EDGE_M, abs=0.01)


def test_without_voxels_the_cloud_stays_as_it_is() -> None:
    none = OccupancyVoxels(np.zeros((0, 3), np.int32), np.zeros(0, np.float32), EDGE_M)
    cloud = PointCloud(np.ones((4, 3), np.float32), frame="map")
    assert (add_floors(cloud, find_floors(none)).xyz == cloud.xyz).all()
