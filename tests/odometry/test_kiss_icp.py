from __future__ import annotations

import numpy as np
import pytest

from recon.core.errors import RegistrationError
from recon.core.geometry.se3 import apply, exp_so3, invert, make_transform
from recon.odometry.kiss import KissIcp, KissIcpOptions

OPTIONS = KissIcpOptions(max_range_m=30.0, voxel_m=0.3)
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
    icp = KissIcp(OPTIONS)
    icp.set_map(room())
    return icp.align(seen_from(T_MOVED), prior, 0.5).T_world_camera


def test_points_in_camera_axes_give_the_pose_of_the_camera() -> None:
    off = invert(T_MOVED) @ aligned_to_room(np.eye(4))
    # The same surface points are seen again; 5 mm is far below the 300 mm voxel.
    assert np.linalg.norm(off[:3, 3]) < 0.005


def test_register_follows_the_camera_like_kiss_icp() -> None:
    icp = KissIcp(OPTIONS)
    first = icp.register(seen_from(np.eye(4))).T_world_camera
    second = icp.register(seen_from(T_MOVED)).T_world_camera
    np.testing.assert_allclose(first, np.eye(4), atol=1e-9)
    # The default convergence criterion is 1e-4 and points are voxel-sampled: centimetres.
    assert np.linalg.norm((invert(T_MOVED) @ second)[:3, 3]) < 0.02


def test_align_leaves_the_map_as_it_is() -> None:
    icp = KissIcp(OPTIONS)
    icp.set_map(room())
    before = icp.state()["points"]
    icp.align(seen_from(T_MOVED), np.eye(4), 0.5)
    np.testing.assert_array_equal(icp.state()["points"], before)


def test_read_only_arrays_are_taken_and_left_alone() -> None:
    xyz = seen_from(np.eye(4)).astype(np.float32)
    pose = np.eye(4)
    copy = xyz.copy()
    xyz.flags.writeable = pose.flags.writeable = False
    icp = KissIcp(OPTIONS)
    icp.set_map(xyz)
    icp.align(xyz, pose, 0.5)
    np.testing.assert_array_equal(xyz, copy)


def test_without_a_map_the_guess_stays() -> None:
    alignment = KissIcp(OPTIONS).align(seen_from(np.eye(4)), T_MOVED, 0.5)
    np.testing.assert_allclose(alignment.T_world_camera, T_MOVED, atol=1e-12)


def test_a_prior_that_is_not_quite_rigid_does_not_end_the_process() -> None:
    prior = np.eye(4)
    prior[:3, :3] *= 1.001
    off = invert(T_MOVED) @ aligned_to_room(prior)
    assert np.linalg.norm(off[:3, 3]) < 0.005


def test_two_runs_are_equal_to_the_bit() -> None:
    np.testing.assert_array_equal(aligned_to_room(np.eye(4)), aligned_to_room(np.eye(4)))


@pytest.mark.parametrize("value", ['{"max_range": 1.0}', "not json"])
def test_environment_variables_change_nothing(value: str, monkeypatch: pytest.MonkeyPatch) -> None:
    expected = aligned_to_room(np.eye(4))
    monkeypatch.setenv("kiss_icp_data", value)
    np.testing.assert_array_equal(aligned_to_room(np.eye(4)), expected)


@pytest.mark.parametrize(
    "xyz", [np.zeros((0, 3)), np.zeros((5, 2)), np.full((5, 3), np.nan), np.zeros(3)]
)
def test_points_that_kiss_icp_would_take_silently_are_refused(xyz: np.ndarray) -> None:
    icp = KissIcp(OPTIONS)
    for call in (icp.register, lambda p: icp.align(p, np.eye(4), 0.5)):
        with pytest.raises(RegistrationError):
            call(xyz)


@pytest.mark.parametrize("pose", [np.full((4, 4), np.nan), np.eye(3)])
def test_a_pose_that_is_none_is_refused(pose: np.ndarray) -> None:
    with pytest.raises(RegistrationError):
        KissIcp(OPTIONS).align(room(), pose, 0.5)


def test_no_foreign_exception_leaks(monkeypatch: pytest.MonkeyPatch) -> None:
    icp = KissIcp(OPTIONS)

    def fail(*_: object) -> None:
        raise RuntimeError("from the library")

    monkeypatch.setattr(icp._icp, "register_frame", fail)
    with pytest.raises(RegistrationError, match="from the library"):
        icp.register(room())


def test_the_threshold_is_that_of_kiss_icp() -> None:
    """Our threshold, unlike that of kiss-icp, can be saved; it gives the same values."""
    from kiss_icp.pybind import kiss_icp_pybind

    from recon.odometry.kiss import _INITIAL_THRESHOLD_M, _MIN_MOTION_M, _AdaptiveThreshold

    theirs = kiss_icp_pybind._AdaptiveThreshold(
        initial_threshold=_INITIAL_THRESHOLD_M, min_motion_th=_MIN_MOTION_M, max_range=30.0
    )
    ours, rng = _AdaptiveThreshold(30.0), np.random.default_rng(4)
    for size in (0.0, 0.001, 0.01, 0.1, 0.5):
        T = make_transform(exp_so3(size * rng.normal(size=3)), size * rng.normal(size=3))
        ours.update_model_deviation(T)
        theirs._update_model_deviation(model_deviation=T)
        assert ours.get_threshold() == pytest.approx(theirs._compute_threshold(), rel=1e-9)


def test_a_saved_state_goes_on_to_the_bit() -> None:
    rng = np.random.default_rng(5)
    world = rng.uniform([-10, -2, 0], [10, 2, 40], (6000, 3))
    options = KissIcpOptions(max_range_m=30.0, voxel_m=0.5)

    def advance(icp: KissIcp, frames: range) -> list[np.ndarray]:
        return [icp.register(world - [0, 0, 0.3 * n]).T_world_camera for n in frames]

    unbroken = KissIcp(options)
    advance(unbroken, range(4))
    saved = KissIcp(options)
    saved.restore(unbroken.state())
    for ours, theirs in zip(
        advance(saved, range(4, 9)), advance(unbroken, range(4, 9)), strict=True
    ):
        np.testing.assert_array_equal(ours, theirs)
