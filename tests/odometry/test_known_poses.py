from __future__ import annotations

from collections.abc import Callable

import numpy as np
import pytest

from recon.core.errors import RegistrationError
from recon.core.geometry.se3 import invert
from recon.core.values import Trajectory
from recon.odometry.known_poses import KnownPoses
from recon.odometry.protocol import Odometry, OdometryFrame

See = Callable[..., OdometryFrame]


def known(poses: np.ndarray) -> KnownPoses:
    return KnownPoses(Trajectory(poses, np.arange(len(poses), dtype=np.float64)))


def test_poses_begin_at_the_identity(blind: See, street_poses: np.ndarray) -> None:
    odometry = known(street_poses[3:])
    for index in range(4):
        result = odometry.register(blind(index=index))
        expected = invert(street_poses[3]) @ street_poses[3 + index]
        np.testing.assert_allclose(result.T_world_camera, expected, atol=1e-12)
        assert result.health.ok
        assert result.health.known


def test_poses_are_picked_by_the_number_of_the_frame(blind: See, street_poses: np.ndarray) -> None:
    odometry = known(street_poses)
    odometry.register(blind(index=2))
    result = odometry.register(blind(index=7))
    np.testing.assert_allclose(
        result.T_world_camera, invert(street_poses[2]) @ street_poses[7], atol=1e-12
    )


def test_a_frame_without_a_pose_is_reported(blind: See, street_poses: np.ndarray) -> None:
    odometry = known(street_poses[:2])
    with pytest.raises(RegistrationError, match=r"frame 2: no known pose .* \(got 2 poses"):
        odometry.register(blind(index=2))


def test_it_is_an_odometry(street_poses: np.ndarray) -> None:
    assert isinstance(known(street_poses), Odometry)
