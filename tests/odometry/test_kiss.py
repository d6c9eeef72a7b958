from __future__ import annotations

from collections.abc import Callable

import numpy as np

from recon.core.geometry.se3 import invert, make_transform
from recon.odometry.kiss import KissOdometry
from recon.odometry.protocol import OdometryFrame

See = Callable[..., OdometryFrame]


def test_a_still_camera_stays(see: See) -> None:
    odometry = KissOdometry(30.0)
    results = [odometry.register(see(np.eye(4))) for _ in range(3)]
    # ICP against its own points: centimetres, from voxels of 0.5 m.
    assert np.linalg.norm(results[-1].T_world_camera[:3, 3]) < 0.05
    assert results[-1].health.icp_points > 100


def test_a_motion_towards_a_wall_is_found(see: See) -> None:
    odometry = KissOdometry(30.0)
    poses = [make_transform(np.eye(3), np.array([0.06 * n, 0.0, 0.0])) for n in range(7)]
    found = [odometry.register(see(T)).T_world_camera for T in poses][-1]
    # The wall tells, the ground does not: a tenth of 0.36 m.
    assert abs(found[0, 3] - poses[-1][0, 3]) < 0.04


def test_smooth_walls_do_not_tell_the_motion_along_them(
    street: tuple[OdometryFrame, ...], street_poses: np.ndarray
) -> None:
    """What no registration of surfaces can do, and why visual odometry is the default."""
    odometry = KissOdometry(30.0)
    results = [odometry.register(frame) for frame in street]
    off = invert(street_poses[-1]) @ results[-1].T_world_camera
    assert np.linalg.norm(off[:3, 3]) > 0.5


def test_an_empty_frame_extrapolates_and_says_so(blind: See, see: See) -> None:
    odometry = KissOdometry(30.0)
    before = [odometry.register(see(np.eye(4))) for _ in range(2)]
    result = odometry.register(blind())
    step = invert(before[0].T_world_camera) @ before[1].T_world_camera
    np.testing.assert_allclose(result.T_world_camera, before[1].T_world_camera @ step, atol=1e-9)
    assert not result.health.ok
    assert "too few" in result.health.notes[0]


def test_an_empty_drive_stays_at_the_identity(blind: See) -> None:
    odometry = KissOdometry(30.0)
    results = [odometry.register(blind()) for _ in range(3)]
    for result in results:
        np.testing.assert_array_equal(result.T_world_camera, np.eye(4))
    assert [result.health.ok for result in results] == [True, False, False]
