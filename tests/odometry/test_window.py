from __future__ import annotations

import numpy as np
import pytest

from recon.core.geometry.projection import project
from recon.core.geometry.se3 import angle_rad, apply, exp_so3, invert, make_transform
from recon.core.values import RectifiedCamera
from recon.odometry import window as bundle_window
from recon.odometry.window import (
    TrackWindow,
    adjust,
    misfits,
    newest_health,
    newest_information,
    pose_information,
    reprojection,
)


@pytest.fixture(autouse=True)
def _to_the_minimum(monkeypatch: pytest.MonkeyPatch) -> None:
    """Adjust until nothing changes any more, not only as far as a drive needs."""
    monkeypatch.setattr(bundle_window, "_ITERATIONS", 30)
    monkeypatch.setattr(bundle_window, "_MIN_GAIN", 1e-9)


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


def test_exact_observations_give_exact_poses_and_points(camera: RectifiedCamera) -> None:
    right = truth(camera)
    found = adjust(disturbed(right), camera)
    error_m, error_rad = newest_error(found, right)
    # The cost is flat at its minimum: square roots of float64's accuracy are left.
    assert error_m < 1e-5
    assert error_rad < 1e-6
    np.testing.assert_allclose(found.xyz_world, right.xyz_world, atol=1e-3)


def test_the_oldest_pose_stays(camera: RectifiedCamera) -> None:
    start = disturbed(truth(camera))
    found = adjust(start, camera)
    np.testing.assert_array_equal(found.T_world_camera[0], start.T_world_camera[0])


def test_some_wrong_tracks_hardly_matter(camera: RectifiedCamera) -> None:
    right = truth(camera)
    uvd = right.uvd.copy()
    uvd[-1, :20, 0] += 15.0
    found = adjust(disturbed(TrackWindow(right.T_world_camera, uvd, right.xyz_world)), camera)
    error_m, _ = newest_error(found, right)
    assert error_m < 0.02
    wrong = misfits(found, camera)
    assert wrong[:20].all()
    assert not wrong[20:].any()


def test_a_track_without_disparity_still_counts(camera: RectifiedCamera) -> None:
    right = truth(camera)
    uvd = right.uvd.copy()
    uvd[1:, :, 2] = np.nan
    found = adjust(disturbed(TrackWindow(right.T_world_camera, uvd, right.xyz_world)), camera)
    assert newest_error(found, right)[0] < 1e-3
    assert np.isnan(reprojection(found, camera)[-1, :, 2]).all()


def test_information_predicts_the_scatter(camera: RectifiedCamera) -> None:
    """Noise of the stated size in the newest frame alone: scatter against the covariance."""
    right = truth(camera, frames=2)
    rng = np.random.default_rng(13)
    sigmas = np.array(
        [bundle_window.SIGMA_UV_PX, bundle_window.SIGMA_UV_PX, bundle_window.SIGMA_D_PX]
    )
    offs = []
    for _ in range(60):
        uvd = right.uvd + sigmas * rng.normal(size=right.uvd.shape)
        found = adjust(TrackWindow(right.T_world_camera, uvd, right.xyz_world), camera)
        offs.append((invert(right.T_world_camera[-1]) @ found.T_world_camera[-1])[:3, 3])
    covariance = np.linalg.inv(pose_information(right, camera))
    ratio = np.std(offs, axis=0) / np.sqrt(np.diag(covariance)[:3])
    # 60 trials: ±10 %; Cauchy weights cost some efficiency and shrink the formal information.
    assert (ratio > 0.7).all()
    assert (ratio < 1.5).all()


def test_health_states_the_certainty_that_the_misfit_of_the_features_gives(
    camera: RectifiedCamera,
) -> None:
    right, sigma_px = truth(camera), 0.4
    uvd = right.uvd.copy()
    uvd[-1, :, :2] += np.random.default_rng(14).normal(0.0, sigma_px, uvd[-1, :, :2].shape)
    noisy = TrackWindow(right.T_world_camera, uvd, right.xyz_world)
    found = newest_health(noisy, camera, tracks=200, note="noted")
    covariance = np.linalg.inv(newest_information(noisy, camera, sigma_px))
    # The median of 150 errors is known to 6 %.
    assert found.sigma_m == pytest.approx(np.sqrt(np.trace(covariance[:3, :3])), rel=0.1)
    turn_deg = np.rad2deg(np.sqrt(np.trace(covariance[3:, 3:])))
    assert found.sigma_deg == pytest.approx(turn_deg, rel=0.1)
    assert (found.tracks, found.inliers, found.notes) == (200, 150, ("noted",))
    d = right.uvd[-1, :, 2] + camera.doffs_px
    assert found.scale_px == pytest.approx(np.average(d, weights=d))


def test_trimming_keeps_what_is_followed_and_what_was_seen_twice(camera: RectifiedCamera) -> None:
    window = truth(camera, frames=4, points=4)
    uvd = window.uvd.copy()
    uvd[3, 0] = uvd[3, 1] = np.nan
    uvd[:2, 1] = np.nan
    uvd[:3, 2] = np.nan
    trimmed = TrackWindow(window.T_world_camera, uvd, window.xyz_world).trimmed(3)
    assert len(trimmed.T_world_camera) == 3
    # Point 0 was seen in frames 1 and 2, point 1 in frame 2 alone; 2 and 3 are followed.
    np.testing.assert_array_equal(trimmed.xyz_world, window.xyz_world[[0, 2, 3]])


@pytest.mark.parametrize("frames", [1, 2])
def test_a_window_without_points_stays_as_it_is(frames: int, camera: RectifiedCamera) -> None:
    poses = truth(camera).T_world_camera[:frames]
    window = TrackWindow(poses, np.zeros((frames, 0, 3)), np.zeros((0, 3)))
    np.testing.assert_array_equal(adjust(window, camera).T_world_camera, poses)
