"""Registration of points by KISS-ICP, and the selection of those points."""

from dataclasses import replace

import numpy as np
import pytest
from kiss_icp.pybind import kiss_icp_pybind

from recon.core.errors import RegistrationError
from recon.core.geometry.se3 import apply, exp_so3, invert, make_transform
from recon.odometry import kiss
from tests.odometry.conftest import PLANES


def test_a_motion_towards_a_wall_is_found(see):
    odometry = kiss.KissOdometry(30.0)
    poses = [make_transform(np.eye(3), np.array([0.06 * n, 0.0, 0.0])) for n in range(7)]
    found = [odometry.register(see(T)).T_world_camera for T in poses][-1]
    # The wall tells, the ground does not: a tenth of 0.36 m.
    assert abs(found[0, 3] - poses[-1][0, 3]) < 0.04


def test_an_empty_frame_extrapolates_and_an_empty_drive_stays(blind, see):
    odometry = kiss.KissOdometry(30.0)
    before = [odometry.register(see(np.eye(4))) for _ in range(2)]
    result = odometry.register(blind())
    step = invert(before[0].T_world_camera) @ before[1].T_world_camera
    np.testing.assert_allclose(result.T_world_camera, before[1].T_world_camera @ step, atol=1e-9)
    assert not result.health.ok
    assert "too few" in result.health.notes[0]
    odometry = kiss.KissOdometry(30.0)
    results = [odometry.register(blind()) for _ in range(3)]
    assert all(np.array_equal(result.T_world_camera, np.eye(4)) for result in results)
    assert [result.health.ok for result in results] == [True, False, False]


def test_selected_points_lie_on_the_street_within_range_and_accuracy(see, monkeypatch):
    xyz = kiss.select_points(see(np.eye(4)), 30.0).xyz
    walls = [np.abs(xyz @ np.array(normal) - offset) for normal, offset, _ in PLANES]
    assert len(xyz) > 1000
    # float32 at some tens of metres.
    assert np.min(walls, axis=0).max() < 1e-4
    frame = see(np.eye(4))
    every = kiss.select_points(frame, 30.0)
    monkeypatch.setattr(kiss, "_MIN_RANGE_M", 6.0)
    monkeypatch.setattr(kiss, "_MAX_SIGMA_M", 0.2)
    cloud = kiss.select_points(frame, 20.0)
    assert cloud.xyz[:, 2].min() >= 6.0
    assert cloud.xyz[:, 2].max() <= 20.0
    assert cloud.sigma_m.max() <= 0.2
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


OPTIONS = kiss.KissIcpOptions(max_range_m=30.0, voxel_m=0.3)
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
    made = kiss.KissIcp(OPTIONS)
    made.set_map(room())
    return made.align(seen_from(T_MOVED), prior, 0.5).T_world_camera


@pytest.mark.parametrize("scale", [1.0, 1.001])
def test_points_in_camera_axes_give_the_pose_of_the_camera(scale):
    """Also from a prior that is not quite rigid, which must not end the process."""
    # The same surface points are seen again; 5 mm is far below the 300 mm voxel.
    off = invert(T_MOVED) @ aligned_to_room(np.diag([scale, scale, scale, 1.0]))
    assert np.linalg.norm(off[:3, 3]) < 0.005


def test_without_a_map_the_guess_stays():
    alignment = kiss.KissIcp(OPTIONS).align(seen_from(np.eye(4)), T_MOVED, 0.5)
    np.testing.assert_allclose(alignment.T_world_camera, T_MOVED, atol=1e-12)


@pytest.mark.parametrize("value", ['{"max_range": 1.0}', "not json"])
def test_environment_variables_change_nothing(value, monkeypatch):
    expected = aligned_to_room(np.eye(4))
    monkeypatch.setenv("kiss_icp_data", value)
    np.testing.assert_array_equal(aligned_to_room(np.eye(4)), expected)


def test_bad_points_and_poses_and_foreign_exceptions_are_refused(monkeypatch):
    icp = kiss.KissIcp(OPTIONS)
    for xyz in (np.zeros((0, 3)), np.zeros((5, 2)), np.full((5, 3), np.nan), np.zeros(3)):
        for call in (icp.register, lambda p: icp.align(p, np.eye(4), 0.5)):
            with pytest.raises(RegistrationError):
                call(xyz)
    for pose in (np.full((4, 4), np.nan), np.eye(3)):
        with pytest.raises(RegistrationError):
            icp.align(room(), pose, 0.5)
    icp = kiss.KissIcp(OPTIONS)

    def fail(*_: object) -> None:
        raise RuntimeError("from the library")

    monkeypatch.setattr(icp._icp, "register_frame", fail)
    with pytest.raises(RegistrationError, match="from the library"):
        icp.register(room())


def test_the_threshold_is_that_of_kiss_icp():
    """Our threshold, unlike that of kiss-icp, can be saved; it gives the same values."""
    theirs = kiss_icp_pybind._AdaptiveThreshold(
        initial_threshold=kiss._INITIAL_THRESHOLD_M,
        min_motion_th=kiss._MIN_MOTION_M,
        max_range=30.0,
    )
    ours, rng = kiss._AdaptiveThreshold(30.0), np.random.default_rng(4)
    for size in (0.0, 0.001, 0.01, 0.1, 0.5):
        T = make_transform(exp_so3(size * rng.normal(size=3)), size * rng.normal(size=3))
        ours.update_model_deviation(T)
        theirs._update_model_deviation(model_deviation=T)
        assert ours.get_threshold() == pytest.approx(theirs._compute_threshold(), rel=1e-9)
