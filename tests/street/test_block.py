"""A street around a block closes, and a repeated one looks the same period after period."""

from __future__ import annotations

import math

import numpy as np
import pytest

from recon.core.errors import SettingsError
from recon.street.materials import ROAD_HALF_M
from recon.street.path import LANE_M, centre_line
from recon.street.render import StreetCamera
from recon.street.settings import CORNER_M, StreetScene
from recon.street.street import build_street

TINY = {"width_px": 96, "height_px": 40, "focal_px": 54.0, "smooth_edges": False}
ON_RAILS = {"sway": 0.0, "noise_dn": 0.0}
BLOCK_M = (80.0, 60.0)
LAP_M = 2 * sum(BLOCK_M) - 8 * CORNER_M + 2 * math.pi * CORNER_M


@pytest.fixture(scope="module")
def block() -> StreetCamera:
    """A drive whose frame 100 stands where frame 0 stood, one lap later."""
    settings = StreetScene(
        path="block", block_m=BLOCK_M, frames=111, speed_m_per_frame=LAP_M / 100, **TINY, **ON_RAILS
    )
    return StreetCamera(build_street(settings))


@pytest.fixture(scope="module")
def repeated() -> StreetCamera:
    settings = StreetScene(
        path="straight", repeat_m=40.0, frames=41, speed_m_per_frame=4.0, **TINY, **ON_RAILS
    )
    return StreetCamera(build_street(settings))


def test_the_line_around_a_block_closes():
    road = centre_line(StreetScene(path="block", block_m=BLOCK_M), 0.0)

    assert road.loop_m == pytest.approx(LAP_M)
    # Steps of 0.25 m replace each corner's arc by chords, all four alike.
    assert road.xy_m[-1] == pytest.approx(road.xy_m[0], abs=1e-9)
    assert road.heading_rad[-1] == pytest.approx(2 * math.pi)


def test_the_second_lap_runs_where_the_first_did(block):
    poses = block.world.T_street_camera

    assert poses[100:] == pytest.approx(poses[:11], abs=1e-9)
    # The car keeps to the outer lane, so a lap of the car is longer than one of the line.
    expected_m = LAP_M - 2 * math.pi * LANE_M
    assert block.world.trajectory.distances_m[100] == pytest.approx(expected_m, rel=0.005)
    assert np.array_equal(block.pair(3).left, block.pair(103).left)
    assert not np.array_equal(block.pair(3).left, block.pair(53).left)


def test_nothing_stands_on_the_road_around_a_block(block):
    road = centre_line(block.world.settings, 0.0)
    corners = block.world.soup.vertices.reshape(-1, 3)
    standing = corners[(corners[:, 2] > 0.3) & (corners[:, 2] < 2.5), :2]

    gap = np.linalg.norm(standing[:, None] - road.xy_m[None, ::8], axis=2).min(axis=1)
    # Parked cars fill the outer 2 m of each side of the road.
    assert gap.min() > ROAD_HALF_M - 2.3


def test_the_inside_of_a_corner_has_no_house(block):
    road = centre_line(block.world.settings, 0.0)
    at = road.loop_m - CORNER_M * math.pi / 4  # the middle of the last corner
    inner = road.points(np.array([at]), np.array([9.0]))[0]
    corners = block.world.soup.vertices.reshape(-1, 3)

    walls = corners[(corners[:, 2] > 5.0)]
    assert np.linalg.norm(walls[:, :2] - inner, axis=1).min() > 2.0


def test_a_repeated_street_looks_and_is_the_same_each_period(repeated):
    here, later, elsewhere = (repeated.pair(k).left.astype(float) for k in (2, 12, 5))

    # Only the grain of the surfaces is of the place, and the end of the street comes nearer.
    assert np.abs(later - here).mean() < 0.3 * np.abs(elsewhere - here).mean()
    here, later = repeated.depth(2), repeated.depth(12)
    both = (here < 60.0) & (later < 60.0)
    assert both.mean() > 0.5
    assert np.allclose(here[both], later[both], atol=1e-4)


@pytest.mark.parametrize(
    "values", [{"path": "block", "block_m": (100.0, 40.0)}, {"path": "curve", "repeat_m": 40.0}]
)
def test_an_impossible_street_is_refused(values):
    with pytest.raises(SettingsError, match=r"block_m|repeat_m"):
        StreetScene.parse(values)
