"""The ground is followed over slopes and gaps, and not up walls or onto roofs."""

from __future__ import annotations

import math

import numpy as np
import pytest

from recon.core.errors import MappingError
from recon.core.values import OccupancyVoxels, PointCloud
from recon.map.ground import surface as ground_file
from recon.map.ground.surface import (
    GroundSettings,
    GroundSurface,
    add_floors,
    estimate_ground_surface,
    find_floors,
)

CAMERA_M = 1.6
PATH = np.stack([np.arange(0, 60, 1.0), np.zeros(60), np.zeros(60)], axis=1)


def _slope(x: np.ndarray, y: np.ndarray) -> np.ndarray:
    """A hill along the drive, and a road that hangs to the side."""
    return 2.0 * np.sin(x / 15) + 0.05 * y


def _ground(seed: int = 0, n: int = 60_000) -> np.ndarray:
    rng = np.random.default_rng(seed)
    x, y = rng.uniform(0, 60, n), rng.uniform(-12, 12, n)
    return np.stack([x, y, _slope(x, y) + rng.normal(0, 0.03, n)], axis=1)


def _path() -> np.ndarray:
    path = PATH.copy()
    path[:, 2] = _slope(path[:, 0], path[:, 1]) + CAMERA_M
    return path


def _surface(points: np.ndarray, **settings: float) -> GroundSurface:
    cloud = PointCloud(points.astype(np.float32), frame="map")
    return estimate_ground_surface(cloud, _path(), GroundSettings(**settings))


@pytest.mark.parametrize(
    ("points", "path", "words"),
    [
        (PointCloud(np.zeros((0, 3), np.float32), frame="world"), PATH, "map axes"),
        (PointCloud(np.zeros((0, 3), np.float32), frame="map"), PATH[:0], "path is empty"),
    ],
)
def test_wrong_input_is_refused(points: PointCloud, path: np.ndarray, words: str) -> None:
    with pytest.raises(MappingError, match=words):
        estimate_ground_surface(points, path, GroundSettings())


def _error(surface: GroundSurface, half_width: float = 10.0) -> np.ndarray:
    rng = np.random.default_rng(9)
    x, y = rng.uniform(1, 59, 3000), rng.uniform(-half_width, half_width, 3000)
    return surface.height_at(np.stack([x, y], axis=1)) - _slope(x, y)


def test_slopes_are_followed() -> None:
    surface = _surface(_ground())
    assert surface.camera_height_m == pytest.approx(CAMERA_M, abs=0.03)
    # Slope up to 13 % and 25 points per cell: what is left is smoothing over curvature.
    assert np.abs(_error(surface)).max() < 0.1
    given = _surface(_ground(), camera_height_m=CAMERA_M)
    assert given.camera_height_m == CAMERA_M
    assert np.abs(_error(given)).max() < 0.1
    cloud = PointCloud(_ground().astype(np.float32), frame="map")
    of_one_frame = estimate_ground_surface(cloud, _path()[30:31], GroundSettings())
    height_m = float(_slope(np.array(33.0), np.array(2.0)))
    assert of_one_frame.height_at(np.array([[33.0, 2.0]]))[0] == pytest.approx(height_m, abs=0.1)


def test_what_is_beyond_the_reach_or_has_no_ground_is_unknown() -> None:
    surface = _surface(_ground(), reach_m=5.0)
    assert np.isnan(surface.height_at(np.array([[30.0, 9.0], [1e4, -1e4]]))).all()
    nothing = _surface(np.zeros((0, 3)))
    assert np.isnan(nothing.heights_m).all()
    assert math.isnan(nothing.camera_height_m)


def test_boxes_and_walls_do_not_lift_the_ground() -> None:
    rng = np.random.default_rng(1)
    x, y = rng.uniform(10, 16, 20_000), rng.uniform(3, 6, 20_000)
    roof = np.stack([x, y, _slope(x, y) + 1.5], axis=1)
    x = rng.uniform(0, 60, 40_000)
    wall = np.stack([x, np.full(40_000, 9.0), _slope(x, 9.0) + rng.uniform(0, 4, 40_000)], axis=1)
    clear = _ground()
    under = (clear[:, 0] > 10) & (clear[:, 0] < 16) & (clear[:, 1] > 3) & (clear[:, 1] < 6)
    surface = _surface(np.vstack([clear[~under], roof, wall]))
    # The foot of the wall lies within the window and lifts its own cells a little.
    assert np.abs(_error(surface, half_width=7.5)).max() < 0.15


def test_normals_tell_the_ground_from_the_rest() -> None:
    ground = _ground(n=20_000)
    hedge = ground + np.array([0, 0, 0.25])
    normals = np.zeros((40_000, 3), np.float32)
    normals[:20_000, 2] = 1
    normals[20_000:, 1] = 1
    cloud = PointCloud(np.vstack([ground, hedge]).astype(np.float32), normals=normals, frame="map")
    surface = estimate_ground_surface(cloud, _path(), GroundSettings())
    assert np.abs(_error(surface)).max() < 0.15
    without = _surface(np.vstack([ground, hedge]))
    assert np.abs(np.nanmean(_error(without))) > 2 * abs(np.nanmean(_error(surface)))


def test_heights_are_carried_over_small_gaps_and_not_over_large_ones(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    points = _ground()
    small = (np.abs(points[:, 1]) > 3) & (np.abs(points[:, 1]) < 5)
    assert np.isfinite(_error(_surface(points[~small]))).all()
    large = np.abs(points[:, 1]) > 3
    monkeypatch.setattr(ground_file, "_MAX_GAP_M", 2.0)
    surface = _surface(points[~large])
    assert np.isnan(surface.height_at(np.array([[30.0, 9.5], [30.0, -9.5]]))).all()
    assert np.isfinite(surface.height_at(np.array([[30.0, 2.0], [30.0, -2.0]]))).all()


def test_height_is_linear_between_centres_of_cells() -> None:
    surface = GroundSurface(np.array([[0.0, 1.0], [2.0, np.nan]]), 1.0, (10.0, 20.0))
    places = np.array([[10.5, 20.5], [11.0, 20.5], [10.5, 21.0], [11.5, 21.5], [10.0, 20.0]])
    heights = surface.height_at(places)
    assert heights[:3].tolist() == [0.0, 0.5, 1.0]
    assert math.isnan(heights[3])
    assert heights[4] == 0.0  # outside of the centres: the nearest cell's


EDGE_M = 0.2
NONE = np.zeros((0, 3), np.float32)
NOTHING = PointCloud(NONE, normals=NONE, frame="map")


def _columns(x: range, y: range, heights: dict[int, float]) -> tuple[np.ndarray, np.ndarray]:
    """Voxels with log-odds by height, the same in every column."""
    keys = [(i, j, k) for i in x for j in y for k in heights]
    return np.array(keys, np.int32), np.tile(list(heights.values()), len(x) * len(y))


def _voxels(*parts: tuple[np.ndarray, np.ndarray]) -> OccupancyVoxels:
    keys, values = (np.concatenate(p) for p in zip(*parts, strict=True))
    return OccupancyVoxels(keys, values.astype(np.float32), EDGE_M)


ROAD = _columns(range(20), range(5), {-8: 2.0, -7: -1.0, -6: -1.0})
WALL = _columns(range(20), range(5, 6), dict.fromkeys(range(-8, 4), 2.0))


def test_floors_are_occupied_voxels_below_free_ones() -> None:
    added = add_floors(NOTHING, find_floors(_voxels(ROAD, WALL)))
    none = OccupancyVoxels(np.zeros((0, 3), np.int32), np.zeros(0, np.float32), EDGE_M)
    assert len(find_floors(none)) == len(add_floors(NOTHING, find_floors(none))) == 0
    assert len(added) == 100
    assert added.xyz[:, 2] == pytest.approx(-7.5 * EDGE_M)
    assert added.xyz[:, 1].max() < 1.0
    assert (added.normals == [0, 0, 1]).all()


def test_a_floor_may_share_its_evidence_with_the_voxel_above() -> None:
    undecided = _columns(range(5), range(5), {-8: 2.0, -7: 0.1, -6: -1.0})
    thick = _columns(range(10, 15), range(5), {-8: 2.0, -7: 2.0, -6: -1.0})
    unknown = _columns(range(20, 25), range(5), {-8: 2.0})
    added = add_floors(NOTHING, find_floors(_voxels(undecided, thick, unknown)))
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
    monkeypatch.setattr(ground_file, "_MAX_GAP_M", 2.0)
    settings = GroundSettings()
    assert np.isnan(estimate_ground_surface(cloud, path, settings).height_at(place)).all()
    floor = add_floors(cloud, find_floors(_voxels(long)))
    height = estimate_ground_surface(floor, path, settings).height_at(place)
    assert height == pytest.approx(-7.5 * EDGE_M, abs=0.01)
