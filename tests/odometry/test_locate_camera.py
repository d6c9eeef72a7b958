"""A camera is localised from the inliers among its points."""

from __future__ import annotations

import numpy as np
import pytest

from recon.core.geometry.projection import depth_from_disparity, project, unproject
from recon.core.geometry.se3 import angle_rad, apply, exp_so3, invert, make_transform
from recon.core.values import RectifiedCamera
from recon.core.values.arrays import Float64
from recon.odometry.features import MIN_DISPARITY_PX
from recon.odometry.locate_camera import REPROJECTION_PX, Motion, locate_camera, part_of

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
def test_noisy_depths_do_not_throw_the_camera(seed: int) -> None:
    # Regression: a point on the horizon throws RANSAC's own pose, a closed form, by kilometres.
    xyz, uv = street(seed)
    found = locate_camera(xyz, uv, CAMERA, np.eye(4))
    assert found is not None
    error = invert(T_TRUE) @ found.T_world_camera
    assert np.linalg.norm(error[:3, 3]) < 0.12
    assert np.rad2deg(angle_rad(error)) < 0.3
    assert found.agree.sum() > 120
    assert found.agree[:12].sum() <= 1


def test_those_that_agree_lie_within_the_tolerance_of_the_pose() -> None:
    xyz, uv = street(0)
    found = locate_camera(xyz, uv, CAMERA, np.eye(4))
    assert found is not None
    u, v, _ = project(apply(invert(found.T_world_camera), xyz), CAMERA)
    error_px = np.hypot(u - uv[:, 0], v - uv[:, 1])
    np.testing.assert_array_equal(found.agree, error_px <= REPROJECTION_PX)


def test_a_guess_that_is_far_off_does_no_harm() -> None:
    xyz, uv = street(1)
    far = make_transform(exp_so3(np.array([0.0, 0.3, 0.0])), np.array([3.0, 0.0, -4.0]))
    found = locate_camera(xyz, uv, CAMERA, far)
    assert found is not None
    assert np.linalg.norm((invert(T_TRUE) @ found.T_world_camera)[:3, 3]) < 0.12


def test_points_that_agree_on_nothing_give_no_pose() -> None:
    rng = np.random.default_rng(2)
    xyz, uv = street(2)
    found = locate_camera(xyz, rng.permutation(uv), CAMERA, np.eye(4))
    assert found is None


def test_too_few_points_give_no_pose() -> None:
    xyz, uv = street(3)
    assert locate_camera(xyz[-10:], uv[-10:], CAMERA, np.eye(4)) is None


STEP = make_transform(exp_so3(np.array([0.0, 0.03, 0.01])), np.array([0.1, 0.0, 1.2]))


def test_with_known_times_the_velocity_goes_on() -> None:
    motion = Motion(np.eye(4), 0.0).moved(STEP, 0.1)
    np.testing.assert_allclose(motion.predict(0.2), STEP @ STEP, atol=1e-12)
    np.testing.assert_allclose(motion.predict(0.4), STEP @ part_of(STEP, 3.0), atol=1e-12)


@pytest.mark.parametrize("time_s", [0.0, 0.1, 1000.0, -5.0])
def test_times_that_give_no_answer_repeat_the_last_motion(time_s: float) -> None:
    motion = Motion(np.eye(4), 0.0).moved(STEP, 0.1)
    np.testing.assert_allclose(motion.predict(time_s), STEP @ STEP, atol=1e-12)


def test_sources_without_times_repeat_the_last_motion() -> None:
    motion = Motion(np.eye(4), 0.0).moved(STEP, 0.0)
    np.testing.assert_allclose(motion.predict(0.0), STEP @ STEP, atol=1e-12)


def test_frames_that_are_not_seen_keep_the_velocity() -> None:
    motion = Motion(np.eye(4), 0.0).moved(STEP, 0.1).drifted(0.2).drifted(0.3)
    np.testing.assert_allclose(motion.T_world_camera, np.linalg.matrix_power(STEP, 3), atol=1e-12)
    np.testing.assert_allclose(motion.predict(0.4), np.linalg.matrix_power(STEP, 4), atol=1e-12)


def test_half_a_motion_done_twice_turns_as_far() -> None:
    half = part_of(STEP, 0.5)
    np.testing.assert_allclose((half @ half)[:3, :3], STEP[:3, :3], atol=1e-12)
