"""What the vehicle drove over is free, as long as nothing was seen there on a later visit."""

from __future__ import annotations

import numpy as np
import pytest

from recon.core.errors import MappingError
from recon.core.geometry.se3 import apply, exp_so3, make_transform
from recon.core.kernels.voxels import pack_keys
from recon.core.values import FREE, OCCUPIED, OccupancyGrid, PointCloud
from recon.core.values.grid import log_odds
from recon.map.ground.axes import AXES_MAP_WORLD, AxesSettings, GroundPlane, base_axes, map_axes
from recon.map.ground.driven import DrivenPath, is_driven, sweep
from recon.map.ground.grid import GridSettings, flatten
from recon.map.ground.surface import GroundSurface
from recon.map.occupancy.builder import OccupancyBuilder, OccupancySettings
from recon.map.occupancy.part import OccupancyPart, free_part, join_occupancy

HEIGHT_M, CELL_M = 1.6, 0.2
EMPTY = log_odds(0.12)
T_MAP_WORLD = make_transform(AXES_MAP_WORLD, np.zeros(3))


def _ground(drops_m: float | None = None) -> GroundSurface:
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


def test_a_vehicle_takes_up_its_width_from_the_ground_to_the_camera() -> None:
    keys = sweep(_line(), _ground(), 1.0, CELL_M)
    centres = (keys + 0.5) * CELL_M
    assert len(np.unique(keys, axis=0)) == len(keys)
    # Centres of voxels within half a width of y = 0.05, and between -1.6 and 0 m.
    assert np.abs(centres[:, 1] - 0.05).max() <= 0.5
    assert np.unique(centres[:, 1]).tolist() == pytest.approx([-0.3, -0.1, 0.1, 0.3, 0.5])
    assert (centres[:, 2].min(), centres[:, 2].max()) == pytest.approx((-1.5, -0.1))
    # Half a width before the start, and behind the end.
    assert centres[:, 0].min() == pytest.approx(-0.3)
    narrow = sweep(np.array([[0.45, 0.45, 0.0]]), _ground(), 0.1, 0.5)
    assert np.unique(narrow[:, :2], axis=0).tolist() == [[0, 0]]


def test_above_a_table_or_without_ground_nothing_is_taken_up() -> None:
    assert len(sweep(np.array([[30.0, 0.0, 0.0]]), _ground(), 1.0, CELL_M)) == 0
    assert len(sweep(_line(), _ground(drops_m=0.7), 1.0, CELL_M)) == 0
    assert len(sweep(_line(), _ground(drops_m=1.7), 1.0, CELL_M)) > 0


def test_a_path_is_filled_in_between_trusted_poses_alone() -> None:
    path = np.array([[0, 0, 0], [1, 0, 0], [2, 0, 0], [3, 0, 0], [4, 0, 0]], float)
    whole = _through(path)
    assert np.diff(whole.points_m[:, 0]) == pytest.approx(np.full(40, 0.1))
    assert whole.submap[:12].tolist() == [0] + [1] * 10 + [2]
    broken = _through(path, [True, True, False, True, False])
    assert broken.points_m[:, 0] == pytest.approx([*np.arange(0, 1.05, 0.1), 3.0])
    assert len(_through(path, [False] * 5).points_m) == 0
    assert len(_through(np.zeros((1, 3))).points_m) == 1
    assert _through(np.zeros((5, 3))).submap.tolist() == [0, 1, 2, 3, 4]


def test_cars_and_walkers_drive_and_drones_do_not() -> None:
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


def _plate(z_m: float) -> np.ndarray:
    """A car's rear at depth z, 0.1 to 1.4 m above the road."""
    x, y = np.meshgrid(np.arange(-0.8, 0.8, 0.04), np.arange(0.2, 1.5, 0.04))
    return np.stack([x.ravel(), y.ravel(), np.full(x.size, z_m)], axis=1)


def _flat(parts: list[OccupancyPart]) -> OccupancyGrid:
    return flatten(join_occupancy(parts).voxels(CELL_M), _ground(), GridSettings())


def _cell(grid: OccupancyGrid, x: float, y: float) -> int:
    column, row = (np.array([x, y]) - grid.origin_m) // grid.resolution_m
    return int(grid.cells[int(row), int(column)])


def test_what_drove_off_before_the_vehicle_came_leaves_no_trace() -> None:
    before = _part_of([_plate(3.1)] * 6)
    assert _cell(_flat([before]), 3.1, 0.1) == OCCUPIED
    passed = free_part(sweep(_line(), _ground(), 1.8, CELL_M), EMPTY)
    after = _flat([before, passed])
    assert _cell(after, 3.1, 0.1) == FREE
    # Seen on the track on a later visit, it is there.
    assert _cell(_flat([passed]), 3.1, 0.1) == FREE
    assert _cell(_flat([passed, before]), 3.1, 0.1) == OCCUPIED
    # Beside the vehicle's width, what was seen stays.
    narrow = free_part(sweep(_line(), _ground(), 0.6, CELL_M), EMPTY)
    assert _cell(_flat([before, narrow]), 3.1, 0.6) == OCCUPIED


def test_what_hangs_above_the_camera_stays() -> None:
    # A robot 0.5 m high under a table of 0.75 m: whether others fit below it says the height band.
    low = _line() - np.array([0, 0, HEIGHT_M - 0.5])
    x, z = np.meshgrid(np.arange(-0.5, 0.5, 0.04), np.arange(2.0, 3.0, 0.04))
    table = np.stack([x.ravel(), np.full(x.size, HEIGHT_M - 0.75), z.ravel()], axis=1)
    parts = [_part_of([table] * 6), free_part(sweep(low, _ground(), 1.0, CELL_M), EMPTY)]
    assert _cell(_flat(parts), 2.5, 0.1) == OCCUPIED
    assert _cell(_flat(parts), 0.5, 0.1) == FREE


def test_a_part_of_free_space_has_these_cells_alone() -> None:
    keys = np.array([[0, 0, 0], [7, 8, -1], [-9, 3, 20], [1, 0, 0]], np.int32)
    voxels = free_part(keys, EMPTY).voxels(CELL_M)
    assert sorted(pack_keys(voxels.keys)) == sorted(pack_keys(keys))
    assert voxels.log_odds == pytest.approx(np.full(4, EMPTY))
    assert len(free_part(keys[:0], EMPTY).voxels(CELL_M)) == 0


def test_the_base_is_on_the_ground_below_the_camera() -> None:
    T = base_axes(T_MAP_WORLD, 1.65)
    # A point on the road, 1.65 m below a level camera and 10 m ahead.
    assert apply(T, np.array([[0.0, 1.65, 10.0]])) == pytest.approx(np.array([[10.0, 0.0, 0.0]]))
    assert base_axes(T_MAP_WORLD, None)[:3, 3].tolist() == [0, 0, 0]


@pytest.mark.parametrize("tilt_deg", [0.0, 2.0, 10.0])
def test_with_its_origin_on_the_ground_the_map_starts_at_zero(tilt_deg: float) -> None:
    normal = exp_so3(np.array([np.deg2rad(tilt_deg), 0.0, 0.0])) @ np.array([0.0, -1.0, 0.0])
    ground = GroundPlane(normal, 1.5)
    T = map_axes(ground, AxesSettings(origin="ground"))
    straight_down = T[:3, :3].T @ np.array([0.0, 0.0, -1.0])
    below = straight_down * 1.5 / -(straight_down @ normal)
    assert apply(T, below[None]) == pytest.approx(np.zeros((1, 3)), abs=1e-9)
    T = map_axes(ground, AxesSettings(origin="ground"), camera_height_m=1.4)
    assert T[2, 3] == 1.4


def test_a_map_cannot_start_on_a_ground_that_was_not_seen() -> None:
    with pytest.raises(MappingError, match=r"no ground.*camera_height_m"):
        map_axes(None, AxesSettings(origin="ground"))
    assert map_axes(None, AxesSettings(origin="ground"), camera_height_m=0.4)[2, 3] == 0.4
