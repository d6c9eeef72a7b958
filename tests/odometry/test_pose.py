"""Poses: one camera localised from the inliers of its points, and a window adjusted."""

import numpy as np
import pytest

from recon.core.geometry.se3 import (
    Motion,
    angle_rad,
    apply,
    exp_so3,
    invert,
    make_transform,
    part_of,
)
from recon.core.values import RectifiedCamera
from recon.core.values.arrays import Float64
from recon.core.values.camera import depth_from_disparity, project, unproject
from recon.odometry import pose
from recon.odometry.features import MIN_DISPARITY_PX
from recon.odometry.pose import (
    REPROJECTION_PX,
    TrackWindow,
    adjust,
    locate_camera,
    misfits,
    newest_health,
    newest_information,
    pose_information,
    reprojection,
)


@pytest.fixture(autouse=True)
def _to_the_minimum(monkeypatch):
    """Adjust until nothing changes any more, not only as far as a drive needs."""
    monkeypatch.setattr(pose, "_ITERATIONS", 30)
    monkeypatch.setattr(pose, "_MIN_GAIN", 1e-9)


def seen_as(right: TrackWindow, uvd: np.ndarray) -> TrackWindow:
    return TrackWindow(right.T_world_camera, uvd, right.xyz_world)


def truth(camera: RectifiedCamera, frames: int = 4, points: int = 150) -> TrackWindow:
    """Points in front of a camera that moves forward and turns, all seen exactly."""
    rng = np.random.default_rng(11)
    xyz = rng.uniform([-6, -3, 8], [6, 2, 30], (points, 3))
    step = make_transform(exp_so3(np.array([0.002, 0.01, 0.0])), np.array([0.02, 0.0, 0.5]))
    poses = np.stack([np.linalg.matrix_power(step, n) for n in range(frames)])
    uvd = np.stack([np.stack(project(apply(invert(T), xyz), camera), axis=1) for T in poses])
    return TrackWindow(poses, uvd, xyz)


def disturbed(window: TrackWindow) -> TrackWindow:
    rng = np.random.default_rng(12)
    poses = window.T_world_camera.copy()
    for n in range(1, len(poses)):
        step = make_transform(exp_so3(0.01 * rng.normal(size=3)), 0.1 * rng.normal(size=3))
        poses[n] = poses[n] @ step
    return TrackWindow(poses, window.uvd, window.xyz_world + 0.2 * rng.normal(size=(150, 3)))


def newest_error(window: TrackWindow, right: TrackWindow) -> tuple[float, float]:
    off = invert(right.T_world_camera[-1]) @ window.T_world_camera[-1]
    return float(np.linalg.norm(off[:3, 3])), float(angle_rad(off))


def test_exact_observations_give_exact_poses_and_points(camera):
    right = truth(camera)
    start = disturbed(right)
    found = adjust(start, camera)
    error_m, error_rad = newest_error(found, right)
    # The cost is flat at its minimum: square roots of float64's accuracy are left.
    assert error_m < 1e-5
    assert error_rad < 1e-6
    np.testing.assert_allclose(found.xyz_world, right.xyz_world, atol=1e-3)
    # The oldest pose stays.
    np.testing.assert_array_equal(found.T_world_camera[0], start.T_world_camera[0])


def test_wrong_tracks_hardly_matter_and_those_without_disparity_count(camera):
    right = truth(camera)
    uvd = right.uvd.copy()
    uvd[-1, :20, 0] += 15.0
    found = adjust(disturbed(seen_as(right, uvd)), camera)
    assert newest_error(found, right)[0] < 0.02
    wrong = misfits(found, camera)
    assert wrong[:20].all()
    assert not wrong[20:].any()
    right = truth(camera)
    uvd = right.uvd.copy()
    uvd[1:, :, 2] = np.nan
    found = adjust(disturbed(seen_as(right, uvd)), camera)
    assert newest_error(found, right)[0] < 1e-3
    assert np.isnan(reprojection(found, camera)[-1, :, 2]).all()


def test_information_predicts_the_scatter(camera):
    """Noise of the stated size in the newest frame alone: scatter against the covariance."""
    right = truth(camera, frames=2)
    rng = np.random.default_rng(13)
    sigmas = np.array([pose.SIGMA_UV_PX] * 2 + [pose.SIGMA_D_PX])
    offs = []
    for _ in range(60):
        uvd = right.uvd + sigmas * rng.normal(size=right.uvd.shape)
        found = adjust(seen_as(right, uvd), camera)
        offs.append((invert(right.T_world_camera[-1]) @ found.T_world_camera[-1])[:3, 3])
    covariance = np.linalg.inv(pose_information(right, camera))
    ratio = np.std(offs, axis=0) / np.sqrt(np.diag(covariance)[:3])
    # 60 trials: ±10 %; Cauchy weights cost some efficiency and shrink the formal information.
    assert (ratio > 0.7).all()
    assert (ratio < 1.5).all()


def test_health_states_the_certainty_that_the_misfit_of_the_features_gives(camera):
    right, sigma_px = truth(camera), 0.4
    uvd = right.uvd.copy()
    uvd[-1, :, :2] += np.random.default_rng(14).normal(0.0, sigma_px, uvd[-1, :, :2].shape)
    noisy = seen_as(right, uvd)
    found = newest_health(noisy, camera, tracks=200, note="noted")
    covariance = np.linalg.inv(newest_information(noisy, camera, sigma_px))
    # The median of 150 errors is known to 6 %.
    assert found.sigma_m == pytest.approx(np.sqrt(np.trace(covariance[:3, :3])), rel=0.1)
    turn_deg = np.rad2deg(np.sqrt(np.trace(covariance[3:, 3:])))
    assert found.sigma_deg == pytest.approx(turn_deg, rel=0.1)
    assert (found.tracks, found.inliers, found.notes) == (200, 150, ("noted",))
    d = right.uvd[-1, :, 2] + camera.doffs_px
    assert found.scale_px == pytest.approx(np.average(d, weights=d))


def test_trimming_keeps_what_is_followed_and_what_was_seen_twice(camera):
    window = truth(camera, frames=4, points=4)
    uvd = window.uvd.copy()
    uvd[3, 0] = uvd[3, 1] = np.nan
    uvd[:2, 1] = np.nan
    uvd[:3, 2] = np.nan
    trimmed = seen_as(window, uvd).trimmed(3)
    assert len(trimmed.T_world_camera) == 3
    # Point 0 was seen in frames 1 and 2, point 1 in frame 2 alone; 2 and 3 are followed.
    np.testing.assert_array_equal(trimmed.xyz_world, window.xyz_world[[0, 2, 3]])


@pytest.mark.parametrize("frames", [1, 2])
def test_a_window_without_points_stays_as_it_is(frames, camera):
    poses = truth(camera).T_world_camera[:frames]
    window = TrackWindow(poses, np.zeros((frames, 0, 3)), np.zeros((0, 3)))
    np.testing.assert_array_equal(adjust(window, camera).T_world_camera, poses)


CAMERA = RectifiedCamera(360.0, 320.0, 120.0, 320.0, 0.54, 640, 240)
T_TRUE = make_transform(exp_so3(np.array([0.002, 0.01, -0.003])), np.array([-0.03, -0.02, 1.0]))


def street(seed: int, wrong: int = 12) -> tuple[Float64, Float64]:
    """Points triangulated with 0.3 px of error in the first camera, seen by the second.

    The last two are as far as the horizon, as bundle adjustment makes points of no parallax.
    """
    rng = np.random.default_rng(seed)
    u, v = rng.uniform(0, 640, 150), rng.uniform(0, 240, 150)
    depth = CAMERA.focal_px * CAMERA.baseline_m / rng.uniform(1.0, 40.0, 150)
    depth[-2:] = 20_000.0
    xyz = unproject(u, v, depth, CAMERA)
    seen_u, seen_v, _ = project(apply(invert(T_TRUE), xyz), CAMERA)
    uv = np.stack([seen_u, seen_v], axis=1) + rng.normal(0, 0.15, (150, 2))
    uv[:wrong] += rng.uniform(5, 60, (wrong, 2))
    disparity = CAMERA.focal_px * CAMERA.baseline_m / depth + rng.normal(0, 0.3, 150)
    disparity = np.maximum(disparity, MIN_DISPARITY_PX)
    measured = depth_from_disparity(disparity, CAMERA).astype(np.float64)
    measured[-2:] = depth[-2:]
    return unproject(u, v, measured, CAMERA), uv


@pytest.mark.parametrize("seed", range(30))
def test_noisy_depths_do_not_throw_the_camera(seed):
    # Regression: a point on the horizon throws RANSAC's own pose, a closed form, by kilometres.
    xyz, uv = street(seed)
    found = locate_camera(xyz, uv, CAMERA, np.eye(4))
    error = invert(T_TRUE) @ found.T_world_camera
    assert np.linalg.norm(error[:3, 3]) < 0.12
    assert np.rad2deg(angle_rad(error)) < 0.3
    assert found.agree.sum() > 120
    assert found.agree[:12].sum() <= 1
    u, v, _ = project(apply(invert(found.T_world_camera), xyz), CAMERA)
    error_px = np.hypot(u - uv[:, 0], v - uv[:, 1])
    np.testing.assert_array_equal(found.agree, error_px <= REPROJECTION_PX)


def test_a_far_guess_does_no_harm_and_points_that_agree_on_nothing_give_no_pose():
    xyz, uv = street(1)
    far = make_transform(exp_so3(np.array([0.0, 0.3, 0.0])), np.array([3.0, 0.0, -4.0]))
    found = locate_camera(xyz, uv, CAMERA, far)
    assert np.linalg.norm((invert(T_TRUE) @ found.T_world_camera)[:3, 3]) < 0.12
    xyz, uv = street(2)
    wrong = np.random.default_rng(2).permutation(uv)
    assert locate_camera(xyz, wrong, CAMERA, np.eye(4)) is None
    assert locate_camera(xyz[-10:], uv[-10:], CAMERA, np.eye(4)) is None


STEP = make_transform(exp_so3(np.array([0.0, 0.03, 0.01])), np.array([0.1, 0.0, 1.2]))


def test_the_velocity_goes_on_also_where_frames_are_not_seen():
    motion = Motion(np.eye(4), 0.0).moved(STEP, 0.1)
    np.testing.assert_allclose(motion.predict(0.2), STEP @ STEP, atol=1e-12)
    np.testing.assert_allclose(motion.predict(0.4), STEP @ part_of(STEP, 3.0), atol=1e-12)
    half = part_of(STEP, 0.5)
    np.testing.assert_allclose((half @ half)[:3, :3], STEP[:3, :3], atol=1e-12)
    motion = Motion(np.eye(4), 0.0).moved(STEP, 0.1).drifted(0.2).drifted(0.3)
    np.testing.assert_allclose(motion.T_world_camera, np.linalg.matrix_power(STEP, 3), atol=1e-12)
    np.testing.assert_allclose(motion.predict(0.4), np.linalg.matrix_power(STEP, 4), atol=1e-12)


@pytest.mark.parametrize(
    ("after_s", "time_s"), [(0.1, 0.0), (0.1, 0.1), (0.1, 1000.0), (0.1, -5.0), (0.0, 0.0)]
)
def test_times_that_give_no_answer_repeat_the_last_motion(after_s, time_s):
    motion = Motion(np.eye(4), 0.0).moved(STEP, after_s)
    np.testing.assert_allclose(motion.predict(time_s), STEP @ STEP, atol=1e-12)
