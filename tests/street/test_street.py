"""The street depends only on its settings, and so do the poses of the rig."""

from __future__ import annotations

import math

import numpy as np
import pytest

from recon.core.errors import SettingsError
from recon.core.geometry import se3
from recon.street.materials import ROAD_HALF_M
from recon.street.path import LANE_M, camera_poses, centre_line
from recon.street.render import StreetCamera
from recon.street.settings import CORNER_M, StreetScene
from recon.street.street import build_street

RAILS = {"path": "straight", "sway": 0.0, "yaw_deg": 0.0, "pitch_deg": 0.0, "roll_deg": 0.0}


def _poses(**settings) -> np.ndarray:
    chosen = StreetScene(**settings)
    return camera_poses(chosen, centre_line(chosen, 200.0))


def test_the_first_pose_of_the_trajectory_is_the_identity(street):
    trajectory = street.world.trajectory
    assert np.array_equal(trajectory.T_world_camera[0], np.eye(4))
    assert np.allclose(np.diff(trajectory.timestamps_s), 0.1)


def test_on_rails_the_camera_moves_straight_ahead():
    poses = _poses(frames=5, speed_m_per_frame=0.8, **RAILS)
    T_world_camera = se3.invert(poses[0]) @ poses
    assert np.allclose(T_world_camera[:, :3, :3], np.eye(3))
    assert np.allclose(T_world_camera[:, :3, 3], np.outer(np.arange(5) * 0.8, [0, 0, 1]))


def test_the_mounting_turns_the_view_by_its_angles():
    poses = _poses(frames=1, **{**RAILS, "yaw_deg": 10.0})
    assert np.allclose(poses[0, :3, 2], [np.cos(np.radians(10)), -np.sin(np.radians(10)), 0])
    poses = _poses(frames=1, **{**RAILS, "pitch_deg": 10.0})
    assert np.allclose(poses[0, :3, 2], [np.cos(np.radians(10)), 0, -np.sin(np.radians(10))])


def test_a_curved_street_turns_by_its_rate():
    poses = _poses(frames=101, turn_deg_per_100m=30.0, sway=0.0, yaw_deg=0.0)
    turned = np.degrees(se3.angle_rad(se3.invert(poses[0]) @ poses[-1]))
    # The winding adds at most 0.35 · 18 m of the rate: 1.9° at both ends.
    assert 26.0 < turned < 34.0
    assert poses[-1, 1, 3] > 5.0  # positive = to the left


def test_poses_are_rigid_and_their_steps_have_the_length_of_the_speed():
    poses = _poses(frames=60, speed_m_per_frame=1.0)
    steps = np.linalg.norm(np.diff(poses[:, :3, 3], axis=0), axis=1)
    # The lane lies 1.55 m inside or outside of the centre line, whose curve is above 180 m.
    assert np.allclose(steps, 1.0, atol=0.02)
    rotation = poses[:, :3, :3]
    assert np.allclose(rotation @ rotation.transpose(0, 2, 1), np.eye(3), atol=1e-12)
    assert np.allclose(np.linalg.det(rotation), 1.0)


def test_another_seed_builds_another_street(street):
    other = build_street(StreetScene(seed=4, frames=4))
    assert len(other.soup) != len(street.world.soup)


def test_map_axes_are_level_and_look_along_the_first_view(street):
    world = street.world
    T_map_street = world.T_map_world @ world.T_world_street
    assert np.allclose(T_map_street[2, :3], [0, 0, 1])
    forward = world.T_map_world[:3, 2]
    assert forward[0] > 0.99
    assert forward[1] == pytest.approx(0.0, abs=1e-12)
    assert np.allclose(world.T_map_world[:3, 3], 0.0)


def test_nothing_stands_in_the_lane_of_the_camera(street):
    world = street.world
    centres = world.soup.vertices.mean(axis=1)
    for pose in world.T_street_camera:
        near = np.linalg.norm(centres[:, :2] - pose[:2, 3], axis=1) < 0.9
        assert (centres[near, 2] < 0.05).all()


@pytest.mark.parametrize("wrong", [{"frames": 0}, {"baseline_m": 0.0}, {"colour": 1}])
def test_wrong_settings_are_refused(wrong):
    with pytest.raises(SettingsError):
        StreetScene.parse(wrong)


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
