"""The street depends only on its settings, and so do the poses of the rig."""

from __future__ import annotations

import numpy as np
import pytest

from recon.core.errors import SettingsError
from recon.core.geometry import se3
from recon.street.path import camera_poses, centre_line
from recon.street.settings import StreetScene
from recon.street.street import StreetWorld, build_street

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


def test_the_same_settings_build_the_same_street(street, small_settings):
    one, two = street.world, build_street(small_settings)
    for name in ("vertices", "normals", "uv", "rgb", "material", "part"):
        assert np.array_equal(getattr(one.soup, name), getattr(two.soup, name))
    assert np.array_equal(one.T_street_camera, two.T_street_camera)


def test_another_seed_builds_another_street(street):
    other = build_street(StreetScene(seed=4, frames=4))
    assert len(other.soup) != len(street.world.soup)


def test_the_ground_plane_gives_heights_above_the_road(box_world: StreetWorld):
    plane = box_world.ground_plane(0)
    assert np.allclose(plane, [0.0, -1.0, 0.0, 1.5])


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
