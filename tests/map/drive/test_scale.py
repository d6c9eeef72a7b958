"""Lengths that follow from the scene: the same street in millimetres is the same map, scaled."""

from __future__ import annotations

from dataclasses import replace
from itertools import islice

import numpy as np
import pytest

from recon.commands.config import PAIR_DEFAULTS, ReconConfig, load_config
from recon.map.drive.scale import measure_scene, scale_of
from recon.map.drive.sequence import map_sequence
from recon.sources.synthetic import SyntheticSource
from recon.stereo.frame import FrameReconstructor
from recon.street.settings import StreetScene
from tests.scenery.film import RIG

STREET = SyntheticSource(StreetScene(frames=8, **RIG))


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
    config, pair = load_config(defaults=PAIR_DEFAULTS), next(STREET.frames(3))
    street, small = (
        FrameReconstructor(source.calibration, config).reconstruct(pair).cloud
        for source in (STREET, sized(scale))
    )
    np.testing.assert_allclose(small.xyz, scale * street.xyz, rtol=1e-5)
    np.testing.assert_allclose(small.sigma_m, scale * street.sigma_m, rtol=1e-5)


def test_a_drive_of_millimetres_gives_the_path_and_the_map_of_the_street():
    def mapped(source):
        config = load_config()
        scene = measure_scene(islice(source, 5), source.calibration, config)
        return map_sequence(source, config.at_scale(scene.scale))

    street, small = (mapped(source) for source in (STREET, sized(1e-4)))
    assert small.config.scale == pytest.approx(1e-4 * street.config.scale)
    path = small.trajectory.positions_m / 1e-4
    np.testing.assert_allclose(path, street.trajectory.positions_m, atol=1e-4)
    assert small.trusted.all()
    assert len(small.cloud) == pytest.approx(len(street.cloud), rel=0.002)
    assert len(small.voxels) == pytest.approx(len(street.voxels), rel=0.01)
    extent = np.ptp(small.cloud.xyz, axis=0) / 1e-4
    np.testing.assert_allclose(extent, np.ptp(street.cloud.xyz, axis=0), rtol=0.01)
