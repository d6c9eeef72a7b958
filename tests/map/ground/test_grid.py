"""Axes on the ground, its surface, the flat grid above it, and the space that a vehicle took up."""

import math

import numpy as np
import pytest

from recon.core.errors import MappingError
from recon.core.geometry.se3 import apply, exp_so3
from recon.core.values import FREE, OCCUPIED, UNKNOWN, OccupancyGrid, OccupancyVoxels, PointCloud
from recon.core.values.grid import log_odds
from recon.map.builders import OccupancyBuilder, OccupancySettings
from recon.map.ground import grid as grid_file
from recon.map.ground import surface as ground_file
from recon.map.ground.axes import AxesSettings, GroundPlane, estimate_ground, map_axes
from recon.map.ground.grid import (
    DrivenPath,
    GridSettings,
    drop_undecided,
    flatten,
    ground_depths,
    is_driven,
    sweep,
)
from recon.map.ground.surface import GroundSettings, GroundSurface, add_floors, find_floors
from recon.map.occupancy.part import OccupancyPart, free_part, join_occupancy
from tests.map.walls import T_MAP_WORLD

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
    column, row = (np.array([x, y]) - grid.origin_m) // grid.resolution_m
    return int(grid.cells[int(row), int(column)])


def _flatten(voxels: OccupancyVoxels, ground: GroundSurface, **settings: float) -> OccupancyGrid:
    return flatten(voxels, ground, GridSettings(**settings))


def _slanted_scene() -> OccupancyVoxels:
    """Ground that rises by 10 %, over 20 m, and a box 1 m high on it at x = 15, y = 2."""
    columns = _box((0, -4, 0), (20, 4, 0.2))
    columns[:, 2] = np.floor((SLOPE * (columns[:, 0] + 0.5) * 0.2 - 1.6) / 0.2)
    box = _box((15, 2, -0.1), (16, 3, 0.9))
    return _voxels((columns, 2.0), (columns + np.array([0, 0, 2]), -1.0), (box, 2.0))


def test_a_box_on_slanted_ground_is_occupied_and_the_ground_is_not():
    grid = _flatten(_slanted_scene(), _ground(SLOPE))
    assert _cell(grid, 15.5, 2.5) == OCCUPIED
    assert (grid.cells == OCCUPIED).sum() == 25
    assert (grid.cells == FREE).sum() == grid.cells.size - 25
    # A level band would call the slope an obstacle.
    assert _cell(_flatten(_slanted_scene(), _ground(0.0)), 19.0, -3.0) == OCCUPIED


def test_the_grid_is_the_right_way_round():
    # One obstacle at x = 3, y = -1: row 0 has the smallest y.
    grid = _flatten(
        _voxels(*_road((0, -2), (4, 2)), (_box((3, -1, -1), (3.6, -0.4, 0)), 2.0)), _ground()
    )
    assert (grid.origin_m, grid.cells.shape) == (pytest.approx((0.0, -2.0)), (20, 20))
    rows, columns = np.nonzero(grid.cells == OCCUPIED)
    assert (rows.min(), rows.max()) == (5, 7)
    assert (columns.min(), columns.max()) == (15, 17)


def test_unknown_stays_unknown():
    seen = _road((0, 0), (2, 4))
    above = (_box((2, 0, 0.0), (4, 4, 0.2)), -1.0)
    undecided = (_box((4, 0, -1.0), (5, 4, -0.6)), 0.1)
    grid = _flatten(_voxels(*seen, above, undecided), _ground())
    assert _cell(grid, 1.0, 2.0) == FREE
    # Free only at 1.6 m above ground, as behind a parked car that is looked over.
    assert (_cell(grid, 3.0, 2.0), _cell(grid, 4.5, 2.0)) == (UNKNOWN, UNKNOWN)
    assert (grid.cells != OCCUPIED).all()
    # A parked car whose sides gave no match: the road below it is seen, nothing above it.
    below = (_box((2, 0, -1.6), (4, 2, -1.4)), 2.0)
    over = (_box((2, 0, 0.0), (4, 2, 0.4)), -2.0)
    grid = _flatten(_voxels(*_road((0, 0), (2, 2)), below, over), _ground())
    assert _cell(grid, 3.0, 1.0) == UNKNOWN
    # Where no ground is known, even what is full is unknown.
    far = _voxels((_box((100, 0, -1.6), (104, 4, 1.0)), 2.0))
    assert (_flatten(far, _ground()).cells == UNKNOWN).all()
    low = _voxels((_box((0, 0, -1.0), (4, 4, -0.8)), -1.0))
    assert (_flatten(low, _ground()).cells == FREE).all()


def test_a_bridge_is_driven_under_by_the_height_that_is_set_and_a_speck_is_noise(monkeypatch):
    bridge = _voxels(*_road((0, 0), (4, 4)), (_box((1, 0, 1.0), (2, 4, 1.4)), 2.0))
    speck = _voxels(*_road((0, 0), (4, 4)), (_box((1, 1, -1), (1.2, 1.4, -0.6)), 2.0))
    assert (_flatten(bridge, _ground()).cells == FREE).all()
    assert (_flatten(bridge, _ground(), max_height_m=3.0).cells == OCCUPIED).sum() == 100
    assert (_flatten(speck, _ground()).cells == FREE).all()
    monkeypatch.setattr(grid_file, "MIN_BLOB_CELLS", 1)
    assert (_flatten(speck, _ground()).cells == OCCUPIED).sum() == 2


def test_what_was_hit_behind_a_wall_belongs_to_it(monkeypatch):
    # The wall at x = 2 is sure; behind it the hits of an uncertain depth, then nothing.
    wall = (_box((2, 0, -1.0), (2.2, 4, -0.6)), 2.0)
    behind = (_box((2.2, 0, -1.0), (3.4, 4, -0.6)), 0.01)
    # Seen from above; what is behind a higher wall is that of the wall.
    above = (_box((2.2, 0, 0.6), (3.4, 4, 0.8)), -1.0)
    dark = _flatten(_voxels(*_road((0, 0), (2, 4)), wall, behind), _ground())
    assert dark.cells[10].tolist() == [FREE] * 10 + [OCCUPIED] + [UNKNOWN] * 6
    voxels = _voxels(*_road((0, 0), (2, 4)), wall, behind, above)
    cells = []
    for joined in (0, 1, 2):
        monkeypatch.setattr(grid_file, "JOINED_CELLS", joined)
        cells.append(_cell(_flatten(voxels, _ground()), 2.5, 2.0))
    assert cells == [UNKNOWN, UNKNOWN, OCCUPIED]
    # It goes on for so many cells, and no farther.
    monkeypatch.setattr(grid_file, "JOINED_CELLS", 3)
    assert (_flatten(voxels, _ground()).cells[10] == OCCUPIED).sum() == 4


def test_what_was_hit_before_a_wall_makes_it_no_thicker_but_is_not_free_either():
    wall = (_box((2.4, 0, -1.0), (2.6, 4, -0.6)), 2.0)
    for road_m, low, high, value, row in (
        # Hit alone is no obstacle, and not free.
        (2.0, -1.0, -0.6, 0.01, [FREE, UNKNOWN, UNKNOWN, OCCUPIED]),
        (2.0, -1.0, -0.8, -1.0, [FREE, FREE, FREE, OCCUPIED]),
        # A cell of a free road that was hit low is not free.
        (2.4, -1.0, -0.8, 0.1, [FREE, FREE, UNKNOWN, OCCUPIED]),
        (2.4, -0.4, -0.2, 0.1, [FREE, FREE, FREE, OCCUPIED]),
    ):
        before = (_box((2.0, 0, low), (2.4, 4, high)), value)
        grid = _flatten(_voxels(*_road((0, 0), (road_m, 4)), wall, before), _ground())
        assert grid.cells[10, 9:13].tolist() == row


def test_a_few_voxels_near_a_wall_are_its_smear_and_not_free():
    wall, kerb = _box((2.4, 0, -1.4), (2.6, 4, 0.4)), _box((2.0, 0, -1.2), (2.2, 4, -1.0))
    rows = []
    for smear in (kerb, kerb - np.array([2, 0, 0]), np.vstack([kerb, kerb + np.array([0, 0, 1])])):
        voxels = _voxels(*_road((0, 0), (2.4, 4)), (wall, 2.0), (smear, 2.0))
        rows.append(_flatten(voxels, _ground()).cells[10, 8:13].tolist())
    # One voxel of a column of nine; one too far away; and two.
    assert rows[0] == [FREE, FREE, UNKNOWN, FREE, OCCUPIED]
    assert rows[1] == [OCCUPIED, FREE, FREE, FREE, OCCUPIED]
    assert rows[2] == [FREE, FREE, OCCUPIED, FREE, OCCUPIED]


def test_undecided_voxels_are_dropped():
    values = np.array([2.0, 0.3, 0.1, -0.4, -0.8], np.float32)
    voxels = OccupancyVoxels(np.arange(15, dtype=np.int32).reshape(5, 3), values, 0.2)
    # 0.55 and 0.35 are log-odds of 0.20 and -0.62: one look is not enough for free.
    kept = drop_undecided(voxels)
    assert kept.log_odds.tolist() == pytest.approx([2.0, 0.3, -0.8])
    assert kept.keys[:, 0].tolist() == [0, 3, 12]


def test_impossible_requests_are_refused():
    with pytest.raises(MappingError, match="nothing was observed"):
        _flatten(_voxels((np.zeros((0, 3)), 0.0)), _ground())
    with pytest.raises(MappingError, match="band of the grid is empty"):
        _flatten(_slanted_scene(), _ground(), min_height_m=2.0, max_height_m=1.0)


def test_the_ground_is_as_thick_as_what_is_seen_below_it_but_not_as_deep_as_a_hole():
    road = _box((0, -2, -1.6), (4, 2, -1.4)), 2.0
    low, hole = ((_box((0, -2, z), (4, 0, z + 0.2)), 2.0) for z in (-1.8, -2.4))
    unsure = _box((0, -2, -2.0), (4, 2, -1.8)), 0.05
    depths_m = ground_depths(_voxels(road, low, hole, unsure), _ground())
    np.testing.assert_allclose(depths_m, np.full(200, 0.1), atol=1e-6)


HEIGHT_M, CELL_M = 1.6, 0.2
EMPTY = log_odds(0.12)


def _road_of(drops_m: float | None = None) -> GroundSurface:
    """A level road, 20 x 20 m, 1.6 m below the map's origin."""
    heights = np.full((20, 20), -HEIGHT_M)
    drops = None if drops_m is None else np.full((20, 20), drops_m)
    return GroundSurface(heights, 1.0, (-10.0, -10.0), HEIGHT_M, drops)


def _line(length_m: float = 4.0) -> np.ndarray:
    x = np.arange(0.0, length_m, CELL_M / 2)
    return np.stack([x, np.full(len(x), 0.05), np.zeros(len(x))], axis=1)


def _through(path: np.ndarray, trusted: list[bool] | None = None) -> DrivenPath:
    sure = np.ones(len(path), bool) if trusted is None else np.array(trusted)
    return DrivenPath.through(path, sure, np.arange(len(path)), 0.1)


def test_a_vehicle_takes_up_its_width_from_the_ground_to_the_camera():
    keys = sweep(_line(), _road_of(), 1.0, CELL_M)
    centres = (keys + 0.5) * CELL_M
    assert len(np.unique(keys, axis=0)) == len(keys)
    # Centres of voxels within half a width of y = 0.05, and between -1.6 and 0 m.
    assert np.abs(centres[:, 1] - 0.05).max() <= 0.5
    assert np.unique(centres[:, 1]).tolist() == pytest.approx([-0.3, -0.1, 0.1, 0.3, 0.5])
    assert (centres[:, 2].min(), centres[:, 2].max()) == pytest.approx((-1.5, -0.1))
    # Half a width before the start, and behind the end.
    assert centres[:, 0].min() == pytest.approx(-0.3)
    narrow = sweep(np.array([[0.45, 0.45, 0.0]]), _road_of(), 0.1, 0.5)
    assert np.unique(narrow[:, :2], axis=0).tolist() == [[0, 0]]
    # Above a table, or without ground, nothing.
    assert len(sweep(np.array([[30.0, 0.0, 0.0]]), _road_of(), 1.0, CELL_M)) == 0
    assert len(sweep(_line(), _road_of(drops_m=0.7), 1.0, CELL_M)) == 0
    assert len(sweep(_line(), _road_of(drops_m=1.7), 1.0, CELL_M)) > 0


def test_a_path_is_filled_in_between_trusted_poses_alone():
    path = np.array([[0, 0, 0], [1, 0, 0], [2, 0, 0], [3, 0, 0], [4, 0, 0]], float)
    whole = _through(path)
    assert np.diff(whole.points_m[:, 0]) == pytest.approx(np.full(40, 0.1))
    assert whole.submap[:12].tolist() == [0] + [1] * 10 + [2]
    broken = _through(path, [True, True, False, True, False])
    assert broken.points_m[:, 0] == pytest.approx([*np.arange(0, 1.05, 0.1), 3.0])
    assert len(_through(path, [False] * 5).points_m) == 0
    assert len(_through(np.zeros((1, 3))).points_m) == 1
    assert _through(np.zeros((5, 3))).submap.tolist() == [0, 1, 2, 3, 4]


def test_cars_and_walkers_drive_and_drones_do_not():
    steps = np.arange(200)
    walker = 1.5 + 0.05 * np.sin(steps)
    assert is_driven(walker, 1.5)
    # A flight between half a metre and three metres: the commonest height is one of many.
    drone = 1.75 + 1.25 * np.sin(steps / 20)
    assert not any(is_driven(drone, height) for height in np.arange(0.5, 3.1, 0.25))
    assert not is_driven(walker, float("nan"))
    # A given height of a camera that never sees the ground below its path is believed.
    assert is_driven(np.zeros(0), 0.3)


def _part_of(clouds: list[np.ndarray]) -> OccupancyPart:
    builder = OccupancyBuilder(OccupancySettings(), T_MAP_WORLD)
    for xyz in clouds:
        builder.integrate(PointCloud(xyz.astype("f4")), np.eye(4))
    return builder.part()


def _flat(parts: list[OccupancyPart]) -> OccupancyGrid:
    return flatten(join_occupancy(parts).voxels(CELL_M), _road_of(), GridSettings())


def test_what_drove_off_before_the_vehicle_came_leaves_no_trace():
    # A car's rear, 0.1 to 1.4 m above the road.
    x, y = np.meshgrid(np.arange(-0.8, 0.8, 0.04), np.arange(0.2, 1.5, 0.04))
    before = _part_of([np.stack([x.ravel(), y.ravel(), np.full(x.size, 3.1)], axis=1)] * 6)
    assert _cell(_flat([before]), 3.1, 0.1) == OCCUPIED
    passed = free_part(sweep(_line(), _road_of(), 1.8, CELL_M), EMPTY)
    after = _flat([before, passed])
    assert _cell(after, 3.1, 0.1) == FREE
    # Seen on the track on a later visit, it is there.
    assert _cell(_flat([passed]), 3.1, 0.1) == FREE
    assert _cell(_flat([passed, before]), 3.1, 0.1) == OCCUPIED
    # Beside the vehicle's width, what was seen stays.
    narrow = free_part(sweep(_line(), _road_of(), 0.6, CELL_M), EMPTY)
    assert _cell(_flat([before, narrow]), 3.1, 0.6) == OCCUPIED


def test_what_hangs_above_the_camera_stays():
    # A robot 0.5 m high under a table of 0.75 m: whether others fit below it says the height band.
    low = _line() - np.array([0, 0, HEIGHT_M - 0.5])
    x, z = np.meshgrid(np.arange(-0.5, 0.5, 0.04), np.arange(2.0, 3.0, 0.04))
    table = np.stack([x.ravel(), np.full(x.size, HEIGHT_M - 0.75), z.ravel()], axis=1)
    parts = [_part_of([table] * 6), free_part(sweep(low, _road_of(), 1.0, CELL_M), EMPTY)]
    assert (_cell(_flat(parts), 2.5, 0.1), _cell(_flat(parts), 0.5, 0.1)) == (OCCUPIED, FREE)


@pytest.mark.parametrize("tilt_deg", [0.0, 2.0, 10.0])
def test_with_its_origin_on_the_ground_the_map_starts_at_zero(tilt_deg):
    normal = exp_so3(np.array([np.deg2rad(tilt_deg), 0.0, 0.0])) @ np.array([0.0, -1.0, 0.0])
    ground = GroundPlane(normal, 1.5)
    T = map_axes(ground, AxesSettings(origin="ground"))
    straight_down = T[:3, :3].T @ np.array([0.0, 0.0, -1.0])
    below = straight_down * 1.5 / -(straight_down @ normal)
    assert apply(T, below[None]) == pytest.approx(np.zeros((1, 3)), abs=1e-9)
    T = map_axes(ground, AxesSettings(origin="ground"), camera_height_m=1.4)
    assert T[2, 3] == 1.4
    with pytest.raises(MappingError, match=r"no ground.*camera_height_m"):
        map_axes(None, AxesSettings(origin="ground"))
    assert map_axes(None, AxesSettings(origin="ground"), camera_height_m=0.4)[2, 3] == 0.4


def _street(pitch_deg: float, roll_deg: float = 0.0, height: float = 1.5) -> PointCloud:
    """Ground, a wall to the right and a box, seen by a tilted camera; camera axes."""
    rng = np.random.default_rng(0)
    ground = np.stack([rng.uniform(-4, 4, 6000), np.full(6000, height), rng.uniform(3, 18, 6000)])
    wall = np.stack([np.full(5000, 4.0), rng.uniform(-3, height, 5000), rng.uniform(3, 18, 5000)])
    box = np.stack([rng.uniform(-1, 1, 2000), rng.uniform(0.7, 0.7, 2000), rng.uniform(7, 9, 2000)])
    xyz = np.hstack([ground, wall, box]).T + rng.normal(0, 0.01, (13_000, 3))
    # Camera pitched down: the ground rises in its image.
    turn = exp_so3(np.array([math.radians(-pitch_deg), 0, math.radians(roll_deg)]))
    return PointCloud((xyz @ turn.T).astype(np.float32))


@pytest.mark.parametrize(("pitch", "roll"), [(0.0, 0.0), (2.0, -1.0), (12.0, 0.0), (-8.0, 6.0)])
def test_the_ground_is_found_among_walls_and_boxes(pitch, roll):
    street = _street(pitch, roll)
    plane = estimate_ground(street)
    # 6000 points with 1 cm of noise fix a plane much better than this.
    assert plane.height_m == pytest.approx(1.5, abs=0.01)
    assert plane.tilt_deg == pytest.approx(math.hypot(pitch, roll), abs=0.1)
    assert plane.inliers > 5000
    np.testing.assert_array_equal(plane.normal, estimate_ground(_street(pitch, roll)).normal)
    T = map_axes(plane, AxesSettings())
    assert np.linalg.det(T[:3, :3]) == pytest.approx(1.0, abs=1e-12)
    exact = np.array_equal(T, map_axes(None, AxesSettings()))
    assert exact == (math.hypot(pitch, roll) < 3)
    if not exact:  # large tilts are levelled
        ground = apply(T, street.xyz[:6000].astype(np.float64))
        # Noise of the points is 1 cm; a degree that was left would give 7 cm.
        assert ground[:, 2].std() < 0.02
        assert ground[:, 2].mean() == pytest.approx(-1.5, abs=0.02)
        # Forward stays forward: the short way turns nothing about z.
        assert abs(T[1, 2]) < 0.03


CAMERA_M = 1.6
PATH = np.stack([np.arange(0, 60, 1.0), np.zeros(60), np.zeros(60)], axis=1)


def _slope(x: np.ndarray, y: np.ndarray) -> np.ndarray:
    """A hill along the drive, and a road that hangs to the side."""
    return 2.0 * np.sin(x / 15) + 0.05 * y


def _hill(seed: int = 0, n: int = 60_000) -> np.ndarray:
    rng = np.random.default_rng(seed)
    x, y = rng.uniform(0, 60, n), rng.uniform(-12, 12, n)
    return np.stack([x, y, _slope(x, y) + rng.normal(0, 0.03, n)], axis=1)


def _path() -> np.ndarray:
    path = PATH.copy()
    path[:, 2] = _slope(path[:, 0], path[:, 1]) + CAMERA_M
    return path


def _surface(points: np.ndarray, reach_m: float = 25.0, **settings: float) -> GroundSurface:
    cloud = PointCloud(points.astype(np.float32), frame="map")
    return ground_file.estimate_ground_surface(cloud, _path(), GroundSettings(**settings), reach_m)


@pytest.mark.parametrize(("points", "path", "words"), [
    (PointCloud(np.zeros((0, 3), np.float32), frame="world"), PATH, "map axes"),
    (PointCloud(np.zeros((0, 3), np.float32), frame="map"), PATH[:0], "path is empty"),
])  # fmt: skip
def test_wrong_input_is_refused(points, path, words):
    with pytest.raises(MappingError, match=words):
        ground_file.estimate_ground_surface(points, path, GroundSettings(), 25.0)


def _error(surface: GroundSurface, half_width: float = 10.0) -> np.ndarray:
    rng = np.random.default_rng(9)
    x, y = rng.uniform(1, 59, 3000), rng.uniform(-half_width, half_width, 3000)
    return surface.height_at(np.stack([x, y], axis=1)) - _slope(x, y)


def test_slopes_are_followed():
    surface = _surface(_hill())
    assert surface.camera_height_m == pytest.approx(CAMERA_M, abs=0.03)
    # Slope up to 13 % and 25 points per cell: what is left is smoothing over curvature.
    assert np.abs(_error(surface)).max() < 0.1
    given = _surface(_hill(), camera_height_m=CAMERA_M)
    assert given.camera_height_m == CAMERA_M
    assert np.abs(_error(given)).max() < 0.1
    cloud = PointCloud(_hill().astype(np.float32), frame="map")
    of_one_frame = ground_file.estimate_ground_surface(
        cloud, _path()[30:31], GroundSettings(), 25.0
    )
    height_m = float(_slope(np.array(33.0), np.array(2.0)))
    assert of_one_frame.height_at(np.array([[33.0, 2.0]]))[0] == pytest.approx(height_m, abs=0.1)


def test_boxes_and_walls_do_not_lift_the_ground():
    rng = np.random.default_rng(1)
    x, y = rng.uniform(10, 16, 20_000), rng.uniform(3, 6, 20_000)
    roof = np.stack([x, y, _slope(x, y) + 1.5], axis=1)
    x = rng.uniform(0, 60, 40_000)
    wall = np.stack([x, np.full(40_000, 9.0), _slope(x, 9.0) + rng.uniform(0, 4, 40_000)], axis=1)
    clear = _hill()
    under = (clear[:, 0] > 10) & (clear[:, 0] < 16) & (clear[:, 1] > 3) & (clear[:, 1] < 6)
    surface = _surface(np.vstack([clear[~under], roof, wall]))
    # The foot of the wall lies within the window and lifts its own cells a little.
    assert np.abs(_error(surface, half_width=7.5)).max() < 0.15


def test_normals_tell_the_ground_from_the_rest():
    ground = _hill(n=20_000)
    hedge = ground + np.array([0, 0, 0.25])
    normals = np.zeros((40_000, 3), np.float32)
    normals[:20_000, 2] = 1
    normals[20_000:, 1] = 1
    cloud = PointCloud(np.vstack([ground, hedge]).astype(np.float32), normals=normals, frame="map")
    surface = ground_file.estimate_ground_surface(cloud, _path(), GroundSettings(), 25.0)
    assert np.abs(_error(surface)).max() < 0.15
    without = _surface(np.vstack([ground, hedge]))
    assert np.abs(np.nanmean(_error(without))) > 2 * abs(np.nanmean(_error(surface)))


def test_heights_are_carried_over_small_gaps_alone(monkeypatch):
    points = _hill()
    small = (np.abs(points[:, 1]) > 3) & (np.abs(points[:, 1]) < 5)
    assert np.isfinite(_error(_surface(points[~small]))).all()
    large = np.abs(points[:, 1]) > 3
    monkeypatch.setattr(ground_file, "_MAX_GAP_M", 2.0)
    surface = _surface(points[~large])
    assert np.isnan(surface.height_at(np.array([[30.0, 9.5], [30.0, -9.5]]))).all()
    assert np.isfinite(surface.height_at(np.array([[30.0, 2.0], [30.0, -2.0]]))).all()


EDGE_M = 0.2
NONE = np.zeros((0, 3), np.float32)
NOTHING = PointCloud(NONE, normals=NONE, frame="map")


def _columns(x: range, y: range, heights: dict[int, float]) -> tuple[np.ndarray, np.ndarray]:
    """Voxels with log-odds by height, the same in every column."""
    keys = [(i, j, k) for i in x for j in y for k in heights]
    return np.array(keys, np.int32), np.tile(list(heights.values()), len(x) * len(y))


def _joined(*parts: tuple[np.ndarray, np.ndarray]) -> OccupancyVoxels:
    keys, values = (np.concatenate(p) for p in zip(*parts, strict=True))
    return OccupancyVoxels(keys, values.astype(np.float32), EDGE_M)


ROAD = _columns(range(20), range(5), {-8: 2.0, -7: -1.0, -6: -1.0})


def test_a_floor_may_share_its_evidence_with_the_voxel_above():
    undecided = _columns(range(5), range(5), {-8: 2.0, -7: 0.1, -6: -1.0})
    thick = _columns(range(10, 15), range(5), {-8: 2.0, -7: 2.0, -6: -1.0})
    unknown = _columns(range(20, 25), range(5), {-8: 2.0})
    added = add_floors(NOTHING, find_floors(_joined(undecided, thick, unknown)))
    heights = {x0: added.xyz[np.floor(added.xyz[:, 0]) == x0, 2] for x0 in (0, 2, 4)}
    assert (heights[0], heights[2]) == (pytest.approx(-7.5 * EDGE_M), pytest.approx(-6.5 * EDGE_M))
    assert len(heights[4]) == 0


def test_cells_that_the_cloud_measures_are_left_to_it():
    rng = np.random.default_rng(0)
    xyz = np.column_stack([rng.uniform(0, 2, 200), rng.uniform(0, 1, 200), np.full(200, -1.62)])
    up = np.tile(np.array([0, 0, 1], np.float32), (200, 1))
    cloud = PointCloud(xyz.astype(np.float32), normals=up, frame="map")
    added = add_floors(cloud, find_floors(_joined(ROAD)))
    assert added.xyz[200:, 0].min() > 2.0
    # Points on a wall measure no ground.
    sideways = PointCloud(cloud.xyz, normals=up[:, [2, 0, 1]], frame="map")
    assert add_floors(sideways, find_floors(_joined(ROAD))).xyz[200:, 0].min() < 1.0


def test_the_ground_reaches_as_far_as_the_voxels(monkeypatch):
    path = np.array([[0.5, 0.5, 0.0], [2.0, 0.5, 0.0]])
    long = _columns(range(100), range(-5, 10), {-8: 2.0, -7: -1.0})
    near = np.column_stack([np.random.default_rng(1).uniform(0, 2, (300, 2)), np.full(300, -1.5)])
    cloud = PointCloud(near.astype(np.float32), frame="map")
    place = np.array([[18.0, 0.5]])
    monkeypatch.setattr(ground_file, "_MAX_GAP_M", 2.0)
    how = (GroundSettings(), 25.0)
    assert np.isnan(ground_file.estimate_ground_surface(cloud, path, *how).height_at(place)).all()
    floor = add_floors(cloud, find_floors(_joined(long)))
    height = ground_file.estimate_ground_surface(floor, path, *how).height_at(place)
    assert height == pytest.approx(-7.5 * EDGE_M, abs=0.01)
