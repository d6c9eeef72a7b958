"""A camera is localised from the inliers among its points."""

from __future__ import annotations

import numpy as np
import pytest

from recon.core.geometry.projection import depth_from_disparity, project, unproject
from recon.core.geometry.se3 import angle_rad, apply, exp_so3, invert, make_transform
from recon.core.values import RectifiedCamera
from recon.core.values.arrays import Float64
from recon.odometry.locate_camera import REPROJECTION_PX, locate_camera
from recon.odometry.visual_features import MIN_DISPARITY_PX

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
