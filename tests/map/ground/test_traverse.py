"""Steps, slopes and gaps of analytic ground, measured with noise from a camera that looks ahead."""

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from recon.core.errors import SettingsError
from recon.core.geometry.se3 import apply, invert
from recon.core.values import FREE, OCCUPIED, UNKNOWN, OccupancyGrid, PointCloud
from recon.map.ground.surface import GroundSurface, Raster
from recon.map.ground.traverse import UNSURE, RobotSettings, costs, judge, measure_relief, widened
from recon.map.settings import DriveSettings
from tests.map.walls import T_MAP_WORLD

HEIGHT_M = 1.6
FOCAL_PX = 700.0
RASTER = Raster((0.0, -3.0), 0.2, (30, 60))
ROBOT = RobotSettings()
few = settings(max_examples=8, deadline=None)


def _frames(z_of, *, depth_sigma_px=0.1, frames=6, hidden=None, seed=0, **how):
    """What a camera at z = 0 that moves along x sees of z_of(x, y) - HEIGHT_M."""
    alike, forward_m = how.get("alike", 0.3), how.get("forward_m", 0.4)
    rng = np.random.default_rng(seed)
    out, common = [], rng.normal(size=(300, 300))
    for frame in range(frames):
        T = T_MAP_WORLD.copy()
        T[0, 3] = -2.0 + forward_m * frame
        x, y = rng.uniform([0.0, -3.0], [12.0, 3.0], (12000, 2)).T
        keep = np.ones(len(x), bool) if hidden is None else ~hidden(x, y)
        xyz = np.column_stack([x, y, z_of(x, y) - HEIGHT_M])[keep]
        camera = apply(invert(T), xyz)
        sigma = camera[:, 2] ** 2 * depth_sigma_px / (FOCAL_PX * 0.54)
        # Neighbouring points are off alike, one error for patches of 0.4 m; so are frames in part.
        patch = np.floor(xyz[:, :2] / 0.4).astype(int) + 100
        errors = np.sqrt(alike) * common + np.sqrt(1 - alike) * rng.normal(size=(300, 300))
        off = errors[patch[:, 0], patch[:, 1]] * sigma
        camera *= (1 + off / camera[:, 2])[:, None]
        cloud = PointCloud(camera.astype(np.float32), sigma_m=sigma.astype(np.float32))
        out.append((cloud, T))
    return out


def _flat_ground() -> GroundSurface:
    return GroundSurface(np.full((10, 16), -HEIGHT_M), 1.0, (-2.0, -5.0))


def _costs(z_of, robot=ROBOT, overhead=None, most_m=10.0, **how):
    return _costs_and_risk(z_of, robot, overhead, most_m, **how)[0]


def _costs_and_risk(z_of, robot=ROBOT, overhead=None, most_m=10.0, **how):
    relief = measure_relief(_frames(z_of, **how), _flat_ground(), RASTER, most_m, FOCAL_PX)
    above = np.full(RASTER.shape, FREE, np.int8)
    if overhead is not None:
        above[overhead] = OCCUPIED
    grid = OccupancyGrid(above, RASTER.cell_m, RASTER.origin_m)
    return costs(relief, *judge(relief, robot), robot, grid)


def _at(grid: OccupancyGrid, x: float, y: float = 0.1) -> int:
    column, row = np.floor((np.array([x, y]) - grid.origin_m) / grid.resolution_m).astype(int)
    return int(grid.cells[row, column])


def _along(grid: OccupancyGrid, first: float, last: float) -> np.ndarray:
    columns = slice(*(round(x / RASTER.cell_m) for x in (first, last)))
    return grid.cells[5:-5, columns]


@few
@given(st.floats(-0.12, 0.12), st.floats(-0.08, 0.08), st.integers(0, 10))
def test_a_plane_below_the_limits_is_free_near_by_and_never_an_obstacle(along, across, seed):
    grid = _costs(lambda x, y: along * x + across * y, seed=seed)
    assert not (grid.cells == OCCUPIED).any()
    assert (_along(grid, 1.0, 3.0) == FREE).mean() > 0.9


def test_slope_and_height_are_those_of_the_plane():
    frames = _frames(lambda x, _: 0.1 * x)
    relief = measure_relief(frames, _flat_ground(), RASTER, 10.0, FOCAL_PX)
    steps, slopes = judge(relief, ROBOT)
    middle = np.s_[5:-5, 5:25]
    assert np.median(slopes.value[middle]) == pytest.approx(0.1, abs=0.005)
    assert np.median(steps.value[middle]) < 0.01


def _errors(frames: int, alike: float) -> tuple[float, float]:
    """Root mean square error of heights of flat ground, seen from one place, and what is stated."""
    how = {"frames": frames, "alike": alike, "forward_m": 0.0, "depth_sigma_px": 0.5}
    seen = _frames(lambda x, _: 0.0 * x, **how)
    relief = measure_relief(seen, _flat_ground(), RASTER, 10.0, FOCAL_PX)
    columns = np.s_[5:-5, 35:50]
    error_m, sigma_m = relief.height_m[columns] + HEIGHT_M, relief.sigma_m[columns]
    return float(np.sqrt(np.nanmean(error_m**2))), float(np.sqrt(np.nanmean(sigma_m**2)))


def test_more_frames_make_a_height_better_but_not_as_if_they_were_independent():
    (few_m, few_sigma_m), (many_m, many_sigma_m) = _errors(2, 0.3), _errors(20, 0.3)
    assert 0.4 < few_m / few_sigma_m < 1.1
    assert 0.4 < many_m / many_sigma_m < 1.1
    assert many_sigma_m / few_sigma_m == pytest.approx(many_m / few_m, rel=0.2)
    assert _errors(20, 0.0)[0] < 0.6 * many_m


@few
@given(st.sampled_from([0.27, 0.35, -0.3]), st.integers(0, 10))
def test_a_ramp_above_the_limit_is_an_obstacle_and_nowhere_free(slope, seed):
    grid = _costs(lambda x, _: slope * x, seed=seed)
    assert (_along(grid, 1.0, 3.0) == OCCUPIED).all()
    assert not (grid.cells == FREE).any()


@few
@given(st.sampled_from([0.1, 0.15, 0.2, -0.15]), st.floats(1.5, 3.0), st.integers(0, 10))
def test_a_step_over_the_limit_is_an_obstacle_where_it_is(height, at, seed):
    grid = _costs(lambda x, _: np.where(x > at, height, 0.0), seed=seed)
    columns = _along(grid, at - 0.3, at + 0.3)
    assert (columns == OCCUPIED).any(axis=1).all()
    assert (_along(grid, 0.4, at - 0.8) == FREE).mean() > 0.9


@few
@given(st.floats(0.08, 0.2), st.floats(1.5, 11.0), st.integers(0, 10))
def test_no_row_of_cells_is_free_across_a_step_at_any_distance(height, at, seed):
    grid = _costs(lambda x, _: np.where(x > at, height, 0.0), seed=seed)
    columns = _along(grid, at - 0.5, at + 0.5)
    assert not (columns == FREE).all(axis=1).any()


def test_a_step_below_the_limit_is_no_obstacle():
    grid = _costs(lambda x, _: np.where(x > 2.0, 0.03, 0.0))
    assert not (grid.cells == OCCUPIED).any()


def test_costs_rise_with_a_step_until_it_is_an_obstacle():
    def worst(height):
        grid = _costs(lambda x, _: np.where(x > 2.0, height, 0.0))
        return np.maximum(_along(grid, 1.6, 2.4), FREE).max(axis=1).mean()

    costs_by_height = [worst(height) for height in (0.0, 0.04, 0.05, 0.06, 0.09)]
    assert costs_by_height == sorted(costs_by_height)
    assert costs_by_height[0] == FREE
    assert costs_by_height[-1] == OCCUPIED


def test_what_is_blurred_over_more_than_the_robot_is_free_unsure_or_an_obstacle():
    grid = _costs(lambda x, _: 0.03 * np.sin(5.0 * x))
    assert ((grid.cells > FREE) & (grid.cells < OCCUPIED)).any()
    assert np.isin(_along(grid, 11.0, 12.0), [FREE, UNSURE, OCCUPIED, UNKNOWN]).all()


def test_a_step_that_is_too_far_away_to_be_seen_makes_cells_unsure():
    grid = _costs(lambda x, _: 0.0 * x, depth_sigma_px=1.0)
    assert (_along(grid, 10.0, 11.0) == UNSURE).mean() > 0.9


def test_a_hole_is_not_free_whether_its_floor_is_seen_or_hidden():
    def inside(x, y):
        return (np.abs(x - 2.5) < 0.5) & (np.abs(y) < 0.5)

    seen, risk = _costs_and_risk(lambda x, y: np.where(inside(x, y), -0.3, 0.0))
    hidden = _costs(lambda x, _: 0.0 * x, hidden=inside)
    assert _at(seen, 2.1) == OCCUPIED
    nowhere = np.zeros(RASTER.shape, np.bool_)
    assert not (_along(widened(seen, risk, ROBOT, nowhere), 2.0, 3.0)[8:12] == FREE).any()
    assert _at(hidden, 2.5) == UNKNOWN


def test_a_wheel_bridges_gaps_that_are_shorter_than_its_radius():
    def gap(x, _):
        return np.abs(x - 2.1) < 0.1

    small, large = (RobotSettings(wheel_radius_m=radius) for radius in (0.15, 0.45))
    assert _at(_costs(lambda x, _: 0.0 * x, small, hidden=gap), 2.1) == UNKNOWN
    assert _at(_costs(lambda x, _: 0.0 * x, large, hidden=gap), 2.1) == FREE


def test_what_hangs_over_the_ground_is_an_obstacle_as_the_grid_has_it():
    # Leaves 1.5 m up are no ground; whether the robot passes is in the grid of its height.
    def branch(x, y):
        return np.where((np.abs(x - 2.5) < 0.2) & (np.abs(y) < 0.2), 1.5, 0.0)

    where = np.s_[14:16, 12:13]
    grid = _costs(branch, overhead=where, most_m=0.3)
    assert (grid.cells[where] == OCCUPIED).all()
    assert (grid.cells == OCCUPIED).sum() == 2


def test_ground_without_rays_is_unknown():
    relief = measure_relief([], _flat_ground(), RASTER, 0.3, FOCAL_PX)
    grid = OccupancyGrid(np.full(RASTER.shape, FREE, np.int8), 0.2, RASTER.origin_m)
    assert (costs(relief, *judge(relief, ROBOT), ROBOT, grid)[0].cells == UNKNOWN).all()


NOWHERE = np.zeros((21, 21), np.bool_)


def _widened(value: int, width_m: float, risk: int = 0, driven=NOWHERE) -> np.ndarray:
    """Costs for the middle of a robot on free ground with one cell of a value in its middle."""
    cells, risks = np.zeros((21, 21), np.int8), np.zeros((21, 21), np.uint8)
    cells[10, 10], risks[10, 10] = value, risk
    grid, robot = OccupancyGrid(cells, 0.1, (0.0, 0.0)), RobotSettings(width_m=width_m)
    return widened(grid, risks, robot, driven).cells


def _near(width_m: float) -> np.ndarray:
    rows, columns = np.indices((21, 21)) - 10
    return (np.hypot(rows, columns) - 0.5) * 0.1 < width_m / 2


@pytest.mark.parametrize("value", [OCCUPIED, UNKNOWN])
def test_the_middle_of_a_robot_stays_half_of_its_width_away(value):
    wide, near = _widened(value, 1.0, risk=99), _near(1.0)
    assert (wide[near] == value).all()
    assert (wide[~near] == FREE).all()


def test_beside_what_is_unsure_a_robot_pays_for_the_risk():
    wide, near = _widened(UNSURE, 1.0, risk=80), _near(1.0)
    assert wide[10, 10] == UNSURE
    near[10, 10] = False
    assert (wide[near] == 80).all()
    assert (wide == FREE).sum() == (~_near(1.0)).sum()


def test_a_robot_pays_for_the_worst_that_it_stands_on():
    cells = np.zeros((21, 21), np.int8)
    cells[10, 8], cells[10, 12], cells[0] = 20, 40, OCCUPIED
    wide = widened(
        OccupancyGrid(cells, 0.1, (0.0, 0.0)), cells.astype(np.uint8), ROBOT, NOWHERE
    ).cells  # fmt: skip
    assert (wide[10, 5:9] == 20).all()
    assert (wide[10, 9:16] == 40).all()
    assert (wide[0] == OCCUPIED).all()


def test_a_robot_that_is_wider_than_the_map_goes_nowhere():
    assert (_widened(OCCUPIED, 20.0) == OCCUPIED).all()


def test_where_a_vehicle_drove_nothing_is_unknown():
    driven = NOWHERE.copy()
    driven[10] = True
    assert (_widened(UNKNOWN, 1.0, driven=driven) == FREE).all()
    assert (_widened(UNSURE, 1.0, risk=90, driven=driven) == FREE).all()
    assert _widened(OCCUPIED, 0.6, driven=driven)[10, 10] == OCCUPIED


@pytest.mark.parametrize(
    ("name", "value"),
    [
        ("width_m", 0.0), ("width_m", -1.0), ("width_m", "nan"), ("wheel_radius_m", 0.0),
        ("max_step_m", 0.0), ("max_slope_percent", -5.0),
    ],
)  # fmt: skip
def test_robots_that_cannot_be_are_refused_in_one_line(name, value):
    with pytest.raises(SettingsError, match=f"robot.{name}") as caught:
        DriveSettings.parse({"robot": {name: value}})
    assert "\n" not in str(caught.value)


def test_the_step_follows_from_the_wheel_unless_it_is_set():
    assert RobotSettings(wheel_radius_m=0.2).step_m == pytest.approx(0.08)
    assert RobotSettings(max_step_m=0.03).step_m == 0.03
