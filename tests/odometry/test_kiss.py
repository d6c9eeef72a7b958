"""Registration of points by KISS-ICP, and the selection of those points."""

from dataclasses import replace

import numpy as np
import pytest

from recon.core.errors import RegistrationError
from recon.core.geometry.se3 import apply, exp_so3, invert, make_transform
from recon.odometry import kiss
from recon.odometry.protocol import OdometryHealth, OdometryResult
from recon.odometry.visual import VisualOdometry
from tests.odometry.conftest import PLANES


class Still:
    """Visual odometry that sees no motion."""

    def register(self, frame):
        return OdometryResult(np.eye(4), OdometryHealth())


@pytest.mark.parametrize("visual", [VisualOdometry, Still])
def test_a_motion_towards_a_wall_is_found_whatever_the_guess(see, visual):
    odometry = kiss.KissOdometry(30.0, visual())
    poses = [make_transform(np.eye(3), np.array([0.06 * n, 0.0, 0.0])) for n in range(7)]
    found = [odometry.register(see(T)).T_world_camera for T in poses][-1]
    # The wall tells, the ground does not: a tenth of 0.36 m.
    assert abs(found[0, 3] - poses[-1][0, 3]) < 0.04


def test_an_empty_frame_goes_with_visual_odometry_and_an_empty_drive_stays(blind, see):
    odometry = kiss.KissOdometry(30.0, VisualOdometry())
    before = [odometry.register(see(np.eye(4))) for _ in range(2)]
    result = odometry.register(blind())
    np.testing.assert_allclose(result.T_world_camera, before[1].T_world_camera, atol=1e-3)
    assert not result.health.ok
    assert "too few" in result.health.notes[0]
    odometry = kiss.KissOdometry(30.0, VisualOdometry())
    results = [odometry.register(blind()) for _ in range(3)]
    assert all(np.array_equal(result.T_world_camera, np.eye(4)) for result in results)
    assert not any(result.health.ok for result in results)


def test_selected_points_lie_on_the_street_within_range_and_accuracy(see):
    xyz = kiss.select_points(see(np.eye(4)), 30.0).xyz
    walls = [np.abs(xyz @ np.array(normal) - offset) for normal, offset, _ in PLANES]
    assert len(xyz) > 1000
    # float32 at some tens of metres.
    assert np.min(walls, axis=0).max() < 1e-4
    frame = see(np.eye(4))
    every = kiss.select_points(frame, 30.0)
    cloud = kiss.select_points(frame, 15.0)
    assert 0.5 <= cloud.xyz[:, 2].min() <= cloud.xyz[:, 2].max() <= 15.0
    assert cloud.sigma_m.max() <= 0.5
    assert 0 < len(cloud) < len(every)


def test_what_is_lone_or_changes_down_the_column_alone_is_not_taken(see, blind):
    rows = np.zeros((20, 20), np.uint8)
    rows[10:] = 200
    assert not kiss.textured(rows, 100.0).any()
    assert kiss.textured(np.ascontiguousarray(rows.T), 100.0).any()
    disparity = see(np.eye(4)).disparity
    values = np.full_like(disparity.values, 10.0)
    values[50, 50] = 20.0
    good = kiss.consistent(replace(disparity, values=values), 0.5)
    assert not good[50, 50]
    assert good.sum() == good.size - 1
    assert not kiss.consistent(blind().disparity, 0.5).any()
    assert len(kiss.select_points(blind(), 30.0)) == 0


OPTIONS = {"max_range_m": 30.0, "voxel_m": 0.3}
T_MOVED = make_transform(exp_so3(np.array([0.0, 0.02, 0.0])), np.array([0.1, 0.0, 0.15]))


def room(points: int = 6000) -> np.ndarray:
    """Points on the inside of a box: every direction is fixed."""
    rng = np.random.default_rng(3)
    xyz = rng.uniform(-1, 1, (points, 3)) * [6.0, 3.0, 9.0]
    axis = rng.integers(0, 3, points)
    half = np.array([6.0, 3.0, 9.0])
    xyz[np.arange(points), axis] = np.sign(xyz[np.arange(points), axis]) * half[axis]
    return xyz


def seen_from(T_world_camera: np.ndarray) -> np.ndarray:
    return apply(invert(T_world_camera), room())


def aligned_to_room(prior: np.ndarray) -> np.ndarray:
    made = kiss.KissIcp(**OPTIONS)
    made.set_map(room())
    return made.align(seen_from(T_MOVED), prior, 0.5, 0.25).T_world_camera


@pytest.mark.parametrize("scale", [1.0, 1.001])
def test_points_in_camera_axes_give_the_pose_of_the_camera(scale):
    """Also from a prior that is not quite rigid, which must not end the process."""
    # The same surface points are seen again; 5 mm is far below the 300 mm voxel.
    off = invert(T_MOVED) @ aligned_to_room(np.diag([scale, scale, scale, 1.0]))
    assert np.linalg.norm(off[:3, 3]) < 0.005


def test_frames_that_are_added_make_the_map():
    icp = kiss.KissIcp(**OPTIONS)
    icp.add(seen_from(np.eye(4)), np.eye(4))
    off = invert(T_MOVED) @ icp.align(seen_from(T_MOVED), np.eye(4), 0.5, 0.25).T_world_camera
    # Points are voxel-sampled, and ICP ends at steps of 1e-4: centimetres.
    assert np.linalg.norm(off[:3, 3]) < 0.02


def test_without_a_map_the_guess_stays():
    alignment = kiss.KissIcp(**OPTIONS).align(seen_from(np.eye(4)), T_MOVED, 0.5, 0.25)
    np.testing.assert_allclose(alignment.T_world_camera, T_MOVED, atol=1e-12)


@pytest.mark.parametrize("value", ['{"max_range": 1.0}', "not json"])
def test_environment_variables_change_nothing(value, monkeypatch):
    expected = aligned_to_room(np.eye(4))
    monkeypatch.setenv("kiss_icp_data", value)
    np.testing.assert_array_equal(aligned_to_room(np.eye(4)), expected)


def test_bad_points_and_poses_and_foreign_exceptions_are_refused(monkeypatch):
    icp = kiss.KissIcp(**OPTIONS)
    for xyz in (np.zeros((0, 3)), np.zeros((5, 2)), np.full((5, 3), np.nan), np.zeros(3)):
        for call in (lambda p: icp.add(p, np.eye(4)), lambda p: icp.align(p, np.eye(4), 1, 1)):
            with pytest.raises(RegistrationError):
                call(xyz)
    for pose in (np.full((4, 4), np.nan), np.eye(3)):
        with pytest.raises(RegistrationError):
            icp.align(room(), pose, 0.5, 0.25)
    icp = kiss.KissIcp(**OPTIONS)

    def fail(*_: object) -> None:
        raise RuntimeError("from the library")

    monkeypatch.setattr(icp._icp, "voxelize", fail)
    with pytest.raises(RegistrationError, match="from the library"):
        icp.add(room(), np.eye(4))
