"""The products of a map, made tile by tile, are those of the whole map."""

import re
from dataclasses import replace
from typing import Any

import numpy as np
import pytest

from recon.commands.config import load_config
from recon.core.errors import MappingError, SettingsError
from recon.core.geometry.se3 import apply, exp_so3, make_transform, transform_cloud
from recon.core.values import FREE, OCCUPIED, UNKNOWN, PointCloud
from recon.core.values.arrays import Float64
from recon.export.cloud import CloudSample
from recon.export.costmap import make_costmap
from recon.export.make import Products, make
from recon.export.occupancy import Flattening
from recon.export.product import ExportContext
from recon.io.models.ply import read_ply
from recon.io.models.rasters import read_grid
from recon.map.drive import mapper
from recon.map.drive.sequence import MappedSequence, map_sequence
from recon.map.ground.axes import map_axes
from recon.map.ground.grid import drop_undecided, flatten
from recon.map.ground.surface import add_floors, estimate_ground_surface, find_floors
from recon.map.sessions.placed import PlacedMap, place_map
from recon.run.run import Run
from recon.sources.synthetic import SyntheticSource
from recon.street.settings import StreetScene
from tests.scenery.octomaps import write_octomap

STREET = StreetScene(frames=20, width_px=192, height_px=72, focal_px=110.0, smooth_edges=False)
SETTINGS = ["submaps.length_m=4", "submaps.tile_m=12.8", "fusion.min_count=1"]


@pytest.fixture(scope="module")
def mapped():
    return map_sequence(SyntheticSource(STREET), load_config(None, SETTINGS))


def write_products(mapped: MappedSequence, run: Run) -> Products:
    context = ExportContext(mapped.map, mapped.placed, load_config().mesh)
    return make(context, run.content, ("cloud", "octomap", "grid"))


@pytest.fixture
def folder(tmp_path):
    with Run("map", tmp_path / "run") as run:
        yield run


def test_cloud_and_octomap_of_tiles_are_those_of_the_whole(mapped, folder):
    written = write_products(mapped, folder)
    whole = transform_cloud(mapped.cloud, mapped.T_map_world, frame="map")
    back = read_ply(folder.path("map/cloud.ply"))
    assert written.figures["cloud"].to_json()["points"] == len(back) == len(written.cloud) > 1000
    assert back.frame == "map"
    for name in ("xyz", "normals", "rgb"):
        np.testing.assert_array_equal(getattr(back, name), getattr(whole, name))
    assert written.figures["octomap"].to_json()["voxels"] == len(mapped.voxels) > 1000
    files = write_octomap(folder.path("whole"), drop_undecided(mapped.voxels))
    for theirs, end in zip(files, ("bt", "ot"), strict=True):
        assert folder.path(f"map/octomap.{end}").read_bytes() == theirs.read_bytes()


def test_the_grid_of_tiles_is_that_of_the_whole(mapped, folder):
    config = mapped.config
    cloud = transform_cloud(mapped.cloud, mapped.T_map_world, frame="map")
    path_m = apply(mapped.T_map_world, mapped.trajectory.positions_m)
    floor = add_floors(cloud, find_floors(mapped.voxels))
    ground = estimate_ground_surface(floor, path_m, config.ground, config.occupancy.max_range_m)
    whole = flatten(mapped.voxels, ground, config.grid)
    narrow = load_config(None, [*SETTINGS, "grid.vehicle_width_m=0"])
    written = write_products(replace(mapped, config=narrow), folder).grid
    # Beyond the voxels, there is a margin of at least 5 m around the path.
    low = np.minimum(whole.origin_m, np.floor((path_m.min(axis=0)[:2] - 5) / 0.2) * 0.2)
    np.testing.assert_allclose(written.origin_m, low, atol=1e-9)
    margin = np.rint((np.array(whole.origin_m) - low) / 0.2).astype(int)
    rows, columns = (
        slice(n, n + size) for n, size in zip(margin[::-1], whole.cells.shape, strict=True)
    )
    beyond = written.cells.copy()
    beyond[rows, columns] = UNKNOWN
    assert (beyond == UNKNOWN).all()
    written = replace(written, cells=written.cells[rows, columns])
    # The height of the camera is a median over tiles in place of one over the drive, so a voxel
    # at the very edge of the height band may change sides.
    for value in (OCCUPIED, FREE):
        ours, theirs = written.cells == value, whole.cells == value
        assert (ours & theirs).sum() >= 0.995 * (ours | theirs).sum() > 100


def test_the_vehicle_frees_its_own_track_alone(mapped, folder):
    narrow = load_config(None, [*SETTINGS, "grid.vehicle_width_m=0"])
    seen = write_products(replace(mapped, config=narrow), folder).grid
    grid = write_products(mapped, folder).grid
    np.testing.assert_array_equal(read_grid(folder.path("map/grid.yaml")).cells, grid.cells)
    path_m = apply(mapped.T_map_world, mapped.trajectory.positions_m)[:, :2]
    columns, rows = np.floor((path_m - grid.origin_m) / 0.2).astype(int).T
    assert (seen.cells[rows, columns] == UNKNOWN).sum() >= 2  # the camera does not see its start
    trusted = np.array([record.ok for record in mapped.health])
    assert (grid.cells[rows, columns] == FREE)[trusted].all()
    changed = np.argwhere(grid.cells != seen.cells)[:, ::-1]
    centres = (changed + 0.5) * 0.2 + np.array(grid.origin_m)
    away = np.linalg.norm(centres[:, None] - path_m, axis=2).min(axis=1)
    # Half of 0.6 m from the path, or half of the 1 m between two poses.
    assert len(changed) > 0
    assert away.max() < np.hypot(0.3, 0.55)


@pytest.mark.parametrize("width_m", [9.9, 10.0])
def test_a_vehicle_as_wide_as_the_margin_frees_what_it_passed(mapped, folder, width_m):
    wide = load_config(None, [*SETTINGS, f"grid.vehicle_width_m={width_m}"])
    grid = write_products(replace(mapped, config=wide), folder).grid
    path_m = apply(mapped.T_map_world, mapped.trajectory.positions_m)[:, :2]
    beside_m = path_m[5:15] + np.array([0.0, 2.5])
    aside = np.floor((beside_m - grid.origin_m) / 0.2).astype(int)
    assert (grid.cells[aside[:, 1], aside[:, 0]] == FREE).all()


@pytest.mark.parametrize(
    ("scale", "width_m", "said"),
    [
        (1e-3, 0.6, "no ground was found"), (0.05, 0.6, "no ground was found"), (0.08, 0.6, None),
        (0.08, 0.9, "vehicle_width_m=0.9 is wider than this map is around"), (50, 0.6, None),
    ],
)  # fmt: skip
def test_a_scene_of_any_size_has_a_grid_and_a_vehicle_only_where_it_fits(scale, width_m, said):
    drive = SyntheticSource(STREET.model_copy(update={"frames": 8}))
    small = replace(drive.calibration, baseline_m=scale * drive.calibration.baseline_m)
    config = load_config(None, ["fusion.min_count=1", f"grid.vehicle_width_m={width_m}"])
    made = map_sequence(drive.with_calibration(small), config.at_scale(scale))
    grid, _, warnings = Flattening(made.placed).grid()
    assert (grid.cells == FREE).any() == (scale == 0.08)  # heights are those of robots
    if said is not None:
        assert any(said in text for text in warnings)
    else:
        assert not any("vehicle_width_m" in text for text in warnings)


def test_a_map_too_large_for_an_octomap_has_all_else(mapped, folder, monkeypatch):
    whole = write_products(mapped, folder)
    monkeypatch.setattr("recon.io.models.octomap.KEY_LIMIT", 20)
    folder.path("map/octomap.bt").unlink()
    folder.path("map/octomap.ot").unlink()
    written = write_products(mapped, folder)
    assert (
        written.figures["octomap"].to_json()["voxels"]
        == whole.figures["octomap"].to_json()["voxels"]
    )
    [warning] = written.warnings
    assert "no OctoMap" in warning
    np.testing.assert_array_equal(written.grid.cells, whole.grid.cells)
    assert not [name for name in folder.files() if "octomap" in name]


@pytest.mark.parametrize(
    ("low", "high", "said"),
    [
        (0.05, 2, r"min_height_m=0\.05 is too low .* m thick in cells of 0\.2 m"),
        (0.3, 0.4, r"0\.3 to 0\.4 m, is thinner than a voxel of 0\.2 m"),
        (0.3, 2, None),
    ],
)
def test_a_band_that_the_ground_or_nothing_falls_into_is_warned_of(mapped, folder, low, high, said):
    config = load_config(None, [*SETTINGS, f"grid.min_height_m={low}", f"grid.max_height_m={high}"])
    written = write_products(replace(mapped, config=config), folder)
    warnings = [text for text in written.warnings if "height" in text]
    assert len(warnings) == (said is not None)
    assert said is None or re.search(said, warnings[0])


def test_an_empty_height_band_and_a_grid_that_a_far_pose_makes_too_large_are_refused(
    mapped, folder, tmp_path
):
    config = load_config(None, [*SETTINGS, "grid.min_height_m=2", "grid.max_height_m=1"])
    with pytest.raises(MappingError, match="height band"):
        write_products(replace(mapped, config=config), folder)
    path_m = apply(mapped.T_map_world, mapped.trajectory.positions_m)
    path_m[-1] = (1e4, 1e4, 0.0)
    with pytest.raises(MappingError, match="grid would be too large"):
        Flattening(PlacedMap(mapped.tiles, path_m, np.ones(len(path_m), bool))).grid()


def _random_cloud(seed: int, points: int) -> PointCloud:
    rng = np.random.default_rng(seed)
    return PointCloud(rng.uniform(-20, 20, (points, 3)).astype(np.float32), frame="map")


def test_a_sample_is_small_and_even_and_all_of_a_small_cloud():
    sample, cloud = CloudSample(1000, 0.1), _random_cloud(0, 900)
    assert len(sample.cloud()) == 0
    sample.add(cloud)
    np.testing.assert_array_equal(sample.cloud().xyz, cloud.xyz)
    sample = CloudSample(2000, 0.1)
    for seed in range(20):
        sample.add(_random_cloud(seed, 1500))
    kept = sample.cloud()
    assert 1000 < len(kept) <= 2000
    octants = np.bincount((kept.xyz > 0) @ [1, 2, 4], minlength=8)
    # As many in each eighth of the cube as chance allows: 3 standard deviations of a fraction of
    # 1/8.
    assert np.abs(octants / len(kept) - 1 / 8).max() < 3 * np.sqrt(7 / 64 / len(kept))


def test_a_costmap_of_tiles_lies_on_the_grid_and_has_the_robot_in_it(mapped, folder):
    context = ExportContext(mapped.map, mapped.placed, load_config().mesh)
    made = make(context, folder.content, ("costmap", "grid"))
    costs, grid = made.made["costmap"].value, made.grid
    assert (costs.cells.shape, costs.origin_m) == (grid.cells.shape, grid.origin_m)
    # What is free for a robot of the usual height is free in the grid, too.
    assert (grid.cells[costs.cells == FREE] == FREE).all()
    assert (costs.cells[grid.cells == OCCUPIED] == OCCUPIED).all()
    path_m = mapped.path_m[:, :2]
    column, row = np.floor((path_m - costs.origin_m) / costs.resolution_m).astype(int).T
    assert (costs.cells[row, column] == FREE).all()
    figures = [
        made.figures["costmap"].to_json()[f"costmap_{name}_cells"]
        for name in ("free", "lethal", "uncertain")
    ]
    assert min(figures) > 0
    assert folder.path("map/costmap.png").exists()


def test_a_costmap_without_rays_or_for_a_robot_flatter_than_ground_is_refused(mapped):
    low = load_config(None, [*SETTINGS, "grid.max_height_m=0.2"])
    with pytest.raises(MappingError, match=r"band of the grid is empty.*0.3 to 0.2 m"):
        make_costmap(mapped.map, place_map(mapped.map, low))
    config = load_config(None, [*SETTINGS, "occupancy.keep_rays=false"])
    short = SyntheticSource(STREET.model_copy(update={"frames": 3}))
    without = map_sequence(short, config)
    with pytest.raises(MappingError, match=r"a costmap is made of rays.*keep_rays=true"):
        make_costmap(without.map, without.placed)


def test_a_map_that_is_not_level_is_said_to_be_steep(mapped, monkeypatch):
    tilted = make_transform(exp_so3(np.array([0.0, np.radians(20.0), 0.0])), np.zeros(3))

    def lay_badly(*about: Any) -> Float64:
        return tilted @ map_axes(*about)

    monkeypatch.setattr(mapper, "map_axes", lay_badly)
    short = SyntheticSource(STREET.model_copy(update={"frames": 8}))
    steep = map_sequence(short, load_config(None, [*SETTINGS, "axes.up=[0,-1,0]"]))
    _, warnings = make_costmap(steep.map, steep.placed)
    assert any(re.search(r"\d+ % of the ground .*robot\.max_slope_percent=20", w) for w in warnings)
    assert not any("steeper" in w for w in make_costmap(mapped.map, mapped.placed)[1])


def test_a_robot_wider_than_a_tile_has_no_costmap(mapped):
    # As on a table, whose tiles are smaller than any robot, and which can be mapped all the same.
    wide = load_config(None, [*SETTINGS, "robot.width_m=20"])
    with pytest.raises(MappingError, match=r"wider than a tile .*robot\.width_m=20"):
        make_costmap(mapped.map, place_map(mapped.map, wide))


@pytest.mark.parametrize("setting", ["robot.width_m=-1", "robot.width_m=0", "robot.width_m=21"])
def test_a_robot_that_is_nothing_or_too_wide_for_any_is_refused(setting):
    with pytest.raises(SettingsError, match=r"robot\.width_m"):
        load_config(None, [*SETTINGS, setting])
