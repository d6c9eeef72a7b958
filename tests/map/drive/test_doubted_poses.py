"""Known poses that contradict what the cameras see are doubted aloud; others are not."""

from __future__ import annotations

import numpy as np
import pytest

from recon.core.errors import RegistrationError
from recon.core.geometry.se3 import exp_so3, invert, make_transform
from recon.core.values import Trajectory
from recon.core.values.arrays import Float64
from recon.map.drive.drive_odometry import doubt_poses
from recon.map.settings import DriveSettings
from recon.street.settings import StreetScene
from tests.scenery.film import RIG, Film, film

T_BODY_CAMERA = make_transform(
    np.array([[0.0, 0.0, 1.0], [-1.0, 0.0, 0.0], [0.0, -1.0, 0.0]]), np.zeros(3)
)
T_SURVEY_WORLD = make_transform(exp_so3(np.array([0.0, 2.0, 0.0])), np.array([4e5, 5e6, 100.0]))


def doubts(film: Film, poses: Float64) -> tuple[str, ...]:
    # Poses in KITTI's format have no times; those of the images are another matter.
    known = Trajectory(poses, np.arange(len(poses), dtype=np.float64))
    return doubt_poses(known, film, DriveSettings())


@pytest.fixture(scope="module")
def street() -> Film:
    return film(StreetScene(frames=8, seed=1, **RIG))


@pytest.mark.parametrize("T_there_world", [np.eye(4), T_SURVEY_WORLD])
def test_right_poses_are_not_doubted(street: Film, T_there_world: Float64) -> None:
    assert doubts(street, T_there_world @ street.trajectory.T_world_camera) == ()


def scaled(poses: Float64) -> Float64:
    poses = poses.copy()
    poses[:, :3, 3] *= 1.5
    return poses


@pytest.mark.parametrize("change", [scaled, invert, lambda poses: poses[::-1].copy()])
def test_poses_that_contradict_the_images_are_doubted(street: Film, change) -> None:
    (line,) = doubts(street, change(street.trajectory.T_world_camera))
    assert "contradict what the cameras see" in line
    assert "standard deviations off" in line


def test_poses_of_a_body_are_recognised(street: Film) -> None:
    poses = T_BODY_CAMERA @ street.trajectory.T_world_camera @ invert(T_BODY_CAMERA)
    (line,) = doubts(street, poses)
    assert "as those of a body" in line


def test_a_rig_that_stands_still_doubts_nothing(street: Film) -> None:
    assert doubts(street.taken(slice(0, 1)), np.eye(4)[None]) == ()


def test_fewer_poses_than_frames_are_refused(street: Film) -> None:
    with pytest.raises(RegistrationError, match="fewer known poses than frames"):
        doubts(street, street.trajectory.T_world_camera[:5])
