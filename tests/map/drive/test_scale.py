"""Lengths that follow from the scene: the same street in millimetres is the same map, scaled."""

from __future__ import annotations

from contextlib import closing
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from recon.commands.config import PAIR_DEFAULTS, ReconConfig, load_config
from recon.commands.export import export_map
from recon.commands.map import run_map
from recon.commands.map_options import MapOptions
from recon.core.errors import MappingError
from recon.map.drive.scale import scale_of
from recon.map.fusion import fusion_range_m, voxel_doublings
from recon.map.map import Map
from recon.stereo.frame import FrameReconstructor
from recon.street.settings import StreetScene
from tests.scenery.film import RIG, film

STREET = film(StreetScene(frames=8, **RIG))


def sized(scale: float):
    """The street and its rig, so many times as large: the images are the same."""
    camera = STREET.calibration
    return STREET.with_calibration(replace(camera, baseline_m=scale * camera.baseline_m))


@pytest.mark.parametrize(
    ("depth_m", "sigma_m", "scale"),
    [
        (13.4, 0.27, 1.0),  # a road
        (11.3, 0.17, 1.0),
        (7.0, 0.1, 1.0),  # a narrow one
        (24.0, 0.4, 1.0),  # a wide one
        (2.1, 0.041, 0.2),  # a room
        (2.6, 0.13, 0.5),  # a garden by small images, which place nothing in 2 cm
        (0.05, 5e-4, 0.005),  # an endoscope
        (1e-6, 1e-9, 1e-5),  # nothing has less
        (1e9, 1e9, 1e3),  # or more
    ],
)
def test_scale_follows_from_depth_and_what_the_rig_can_place(depth_m, sigma_m, scale):
    assert scale_of(depth_m, sigma_m) == scale


def test_lengths_that_are_set_stay_and_the_others_follow_once():
    given = load_config(None, ["fusion.voxel_m=0.03"])
    fitted = given.at_scale(0.2)
    assert (fitted.fusion.voxel_m, fitted.fusion.max_depth_error_m) == (0.03, 0.05)
    assert (fitted.map_filters.radius_m, fitted.mesh.tile_m, fitted.scale) == (0.06, 10.0, 0.2)
    assert fitted.grid == given.grid  # that of the vehicle
    assert ReconConfig.parse(fitted.model_dump()).at_scale(5.0) == fitted
    assert load_config(None, ["scene.scale=2"]).at_scale(0.2).fusion.voxel_m == 0.2


@pytest.mark.parametrize("scale", [1e-4, 0.0044 / 0.54])
def test_a_pair_of_millimetres_gives_the_points_of_the_street(scale):
    config, pair = load_config(defaults=PAIR_DEFAULTS), STREET.pairs[3]
    street, small = (
        FrameReconstructor(source.calibration, config).reconstruct(pair).cloud
        for source in (STREET, sized(scale))
    )
    np.testing.assert_allclose(small.xyz, scale * street.xyz, rtol=1e-5)
    np.testing.assert_allclose(small.sigma_m, scale * street.sigma_m, rtol=1e-5)


@pytest.mark.parametrize(
    ("scale", "steps", "farther"),
    [(1.0, 0, 1.0), (0.5, 1, 2**0.5), (0.2, 2, 2.0), (1e-5, 2, 2.0), (50.0, 0, 1.0)],
)
def test_smaller_scenes_are_mapped_farther_in_voxels_that_double(scale, steps, farther):
    fitted, camera = load_config().at_scale(scale), STREET.calibration
    assert fitted.fusion.doublings == steps
    assert fitted.occupancy.max_range_m == pytest.approx(25.0 * scale * farther)
    near_m = fusion_range_m(camera, fitted.fusion.model_copy(update={"doublings": 0}))
    reach_m = fusion_range_m(camera, fitted.fusion)
    assert reach_m == pytest.approx(farther * near_m)
    at_m = np.array([0.1, 1.0, 1.01, farther]) * near_m
    doubled = voxel_doublings(at_m - 1e-9 * near_m, camera, fitted.fusion)
    assert doubled.tolist() == [0, 0, min(1, steps), steps]


def mapped(scale: float, folder: Path):
    options = MapOptions(out=folder / f"{scale:g}", mesh=False, audit=False)
    return run_map(sized(scale), load_config(), options)


@pytest.fixture(scope="module")
def tenth(tmp_path_factory):
    """The street a tenth as large, whose lengths are those of all smaller ones."""
    return mapped(0.1, tmp_path_factory.mktemp("street"))


@pytest.mark.parametrize("scale", [1e-4, 1e-2, pytest.param(1e-3, marks=pytest.mark.slow)])
def test_a_drive_of_any_small_size_gives_the_path_and_the_map_of_a_tenth(scale, tenth, tmp_path):
    same_map(mapped(scale, tmp_path), tenth, scale / 0.1)


@pytest.mark.slow
@pytest.mark.parametrize("scale", [10.0, 100.0])
def test_a_drive_of_any_large_size_gives_the_path_and_the_map_of_the_street(scale, tmp_path):
    same_map(mapped(scale, tmp_path), mapped(1.0, tmp_path), scale)


def same_map(run, other, scale: float) -> None:
    """Path, cloud, occupancy and figures are those of another, times a scale."""
    a, b = run.mapped, other.mapped
    assert a.config.scale == pytest.approx(scale * b.config.scale)
    path = a.trajectory.positions_m / scale
    step_m = b.config.scale  # rounded to float32 at some hundreds of it
    np.testing.assert_allclose(path, b.trajectory.positions_m, atol=1e-4 * step_m)
    assert a.trusted.all()
    assert len(a.cloud) == pytest.approx(len(b.cloud), rel=0.002)
    assert len(a.voxels) == pytest.approx(len(b.voxels), rel=0.01)
    extent = np.ptp(a.cloud.xyz, axis=0) / scale
    np.testing.assert_allclose(extent, np.ptp(b.cloud.xyz, axis=0), rtol=0.01)
    mine, theirs = run.summary.to_json(), other.summary.to_json()
    for name in ("voxel_m", "largest_voxel_m", "reach_m", "reach_error_m"):
        assert mine[name] == pytest.approx(scale * theirs[name])
    assert run.grid.resolution_m == pytest.approx(scale * other.grid.resolution_m)
    # A robot has its own size: it may fit nowhere, which is said.
    where = Path(mine["out"]) / "costmap.yaml"
    with closing(Map.open(Path(mine["out"]))) as map_:
        try:
            export_map(map_, "costmap", where)
        except MappingError:
            assert a.config.scale < 0.1
        else:
            assert where.is_file()
