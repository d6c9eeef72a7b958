"""Transforms, alignment, projection and ray casting: inverses, published numbers, bad input."""

import math
from dataclasses import replace

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from recon.core.errors import FormatError, ShapeError
from recon.core.geometry import se3
from recon.core.geometry.alignment import Similarity, find_agreeing, fit_paths, fit_points
from recon.core.open3d_raycasting import RayScene
from recon.core.values import RectifiedCamera, Trajectory
from recon.core.values.camera import (
    depth_from_disparity,
    depth_sigma,
    disparity_from_depth,
    project,
    unproject,
)

VECTORS = st.tuples(*[st.floats(-3, 3)] * 3).map(np.array)
ROTATIONS = VECTORS.map(se3.exp_so3)
TRANSFORMS = st.builds(se3.make_transform, ROTATIONS, VECTORS)
POINTS = np.random.default_rng(0).uniform(-10, 10, (20, 3))

# float64 on numbers up to about 20.
EXACT = {"rtol": 0, "atol": 1e-12}


@given(steps=st.lists(st.tuples(*[st.floats(-3, 3)] * 6), max_size=4))
def test_a_stack_of_steps_has_the_transform_of_each(steps):
    steps = np.array(steps).reshape(-1, 6)
    each = [se3.as_transform(step) for step in steps]
    np.testing.assert_array_equal(se3.as_transform(steps), np.array(each).reshape(-1, 4, 4))


@given(A=TRANSFORMS, B=TRANSFORMS)
def test_inverses_undo_and_neighbouring_frames_cancel(A, B):
    np.testing.assert_allclose(A @ se3.invert(A), np.eye(4), **EXACT)
    np.testing.assert_array_equal(
        se3.invert(np.stack([A, B])), np.stack([se3.invert(A), se3.invert(B)])
    )
    np.testing.assert_allclose(
        se3.apply(A @ B, POINTS), se3.apply(A, se3.apply(B, POINTS)), **EXACT
    )


@given(T=TRANSFORMS)
def test_a_rigid_motion_keeps_distances_and_dtypes_and_turns_directions(T):
    moved = se3.apply(T, POINTS)
    steps_m = [np.linalg.norm(np.diff(xyz, axis=0), axis=1) for xyz in (moved, POINTS)]
    np.testing.assert_allclose(*steps_m, **EXACT)
    np.testing.assert_allclose(se3.rotate(T, POINTS), moved - T[:3, 3], **EXACT)
    for dtype in (np.float32, np.float64):
        assert (
            se3.apply(T, POINTS.astype(dtype)).dtype
            == se3.rotate(T, POINTS.astype(dtype)).dtype
            == dtype
        )


@given(w=VECTORS)
def test_exp_gives_a_rotation_about_w_by_its_length(w):
    R = se3.exp_so3(w)
    np.testing.assert_allclose(R @ R.T, np.eye(3), **EXACT)
    np.testing.assert_allclose(R @ w, w, **EXACT)
    angle = np.linalg.norm(w) % (2 * np.pi)
    # Near half a turn the sine is small, and its square root of rounding shows.
    np.testing.assert_allclose(
        se3.angle_rad(se3.make_transform(R, np.zeros(3))), min(angle, 2 * np.pi - angle), atol=1e-9
    )


@given(w=VECTORS, v=VECTORS, scale=st.floats(1e-12, 1e-6))
def test_hat_is_cross_product_and_first_order_of_exp(w, v, scale):
    np.testing.assert_allclose(se3.hat(w) @ v, np.cross(w, v), **EXACT)
    # The rest is of second order: |w·scale|² / 2 < 1.5e-11.
    np.testing.assert_allclose(
        se3.exp_so3(w * scale), np.eye(3) + se3.hat(w * scale), rtol=0, atol=2e-11
    )


@given(st.lists(st.floats(-1.5, 1.5), min_size=6, max_size=6))
def test_steps_and_transforms_are_inverse(step):
    # sqrt(3)·1.5 < π, so the rotation vector is unique.
    np.testing.assert_allclose(se3.as_step(se3.as_transform(np.array(step))), step, atol=1e-9)


def test_the_jacobian_of_a_step_is_the_derivative_of_moved_points():
    xyz, h = np.random.default_rng(3).normal(0.0, 5.0, (7, 3)), 1e-6
    for axis, step in enumerate(h * np.eye(6)):
        moved = (
            se3.apply(se3.as_transform(step), xyz) - se3.apply(se3.as_transform(-step), xyz)
        ) / (2 * h)
        # The third derivative, |xyz|·h², and rounding, |xyz|·2⁻⁵²/h: both far below 1e-7.
        np.testing.assert_allclose(se3.step_jacobian(xyz)[:, :, axis], moved, rtol=0, atol=1e-7)


def test_angles_keep_their_precision_and_published_numbers_give_the_published_depth():
    for angle in (1e-9, 1e-5, 1.0, np.pi - 1e-9):
        T = se3.make_transform(se3.exp_so3(np.array([0, angle, 0])), np.zeros(3))
        # acos of the trace would be off by 1e-8.
        np.testing.assert_allclose(se3.angle_rad(T), angle, rtol=0, atol=1e-15 + 1e-14 * angle)
    # Middlebury's own formula Z = baseline·f/(d + doffs), with the numbers of Motorcycle at Q.
    camera = RectifiedCamera(999.421, 294.182, 252.932, 326.96, 0.193001, 741, 497)
    depth = depth_from_disparity(np.array([50.0]), camera)
    assert depth[0] == pytest.approx(193.001e-3 * 999.421 / (50 + 32.778), rel=1e-6)


@given(T=TRANSFORMS, noise=st.integers(0, 1000))
def test_orthonormalising_mends_small_noise(T, noise):
    rough = T.copy()
    rough[:3, :3] += np.random.default_rng(noise).uniform(-1e-4, 1e-4, (3, 3))
    repaired = se3.orthonormalise(rough)
    np.testing.assert_allclose(repaired[:3, :3] @ repaired[:3, :3].T, np.eye(3), **EXACT)
    assert np.linalg.det(repaired[:3, :3]) > 0
    # The nearest rotation is no further from the noisy matrix than the one it came from.
    gaps = [np.linalg.norm(rough[:3, :3] - R[:3, :3]) for R in (repaired, T)]
    assert gaps[0] <= gaps[1] + 1e-12
    np.testing.assert_array_equal(repaired[:3, 3], T[:3, 3])


@given(R=ROTATIONS)
def test_a_rotation_comes_back_from_its_quaternion_of_any_length_and_sign(R):
    xyzw = se3.quaternion_from_rotation(R)
    np.testing.assert_allclose(np.linalg.norm(xyzw), 1, **EXACT)
    assert xyzw[3] >= 0
    np.testing.assert_allclose(se3.rotation_from_quaternion(xyzw), R, **EXACT)
    np.testing.assert_allclose(se3.rotation_from_quaternion(-3 * xyzw), R, **EXACT)


@given(w=VECTORS.filter(lambda v: np.linalg.norm(v) > 0.1), angle=st.floats(0.0, math.pi - 1e-6))
def test_log_is_the_inverse_of_exp(w, angle):
    w = angle * w / np.linalg.norm(w)
    # 1e-7: near π the rotation vector amplifies the matrix's rounding by its square root.
    np.testing.assert_allclose(se3.log_so3(se3.exp_so3(w)), w, atol=1e-7)


@pytest.mark.parametrize("axis", np.eye(3))
def test_half_a_turn_has_an_axis_and_a_quaternion(axis):
    R = 2.0 * np.outer(axis, axis) - np.eye(3)
    w = se3.log_so3(R)
    assert np.linalg.norm(w) == pytest.approx(math.pi)
    np.testing.assert_allclose(se3.exp_so3(w), R, atol=1e-12)
    np.testing.assert_allclose(np.abs(se3.quaternion_from_rotation(R)[:3]), axis, **EXACT)


def moved(x_m: float = 0.0, scale: float = 1.0, last: float = 1.0) -> np.ndarray:
    T = np.diag([scale, 1.0, 1.0, last])
    T[0, 3] = x_m
    return T


@pytest.mark.parametrize(
    "T",
    [
        moved(1.01e5),
        moved(np.nan),
        moved(scale=1.01),
        moved(scale=-1.0),
        moved(last=2.0),
        np.eye(3),
    ],
)
def test_a_pose_that_is_read_and_is_none_is_refused(T):
    se3.check_rigid("T_map_world", moved(0.99e5))
    with pytest.raises(FormatError, match="T_map_world is not a rigid transform"):
        se3.check_rigid("T_map_world", T)


def test_an_uncertain_step_has_the_square_of_its_deviations_and_what_nothing_fixes_100_m():
    covariance = se3.step_covariance(0.2, 3.0)
    angle = np.deg2rad(3.0) ** 2
    np.testing.assert_allclose(covariance, np.diag([0.04] * 3 + [angle] * 3), rtol=1e-12)
    back = se3.covariance_of(np.linalg.inv(covariance))
    np.testing.assert_allclose(back, covariance, rtol=1e-5)
    np.testing.assert_allclose(se3.covariance_of(np.zeros((6, 6))), 100**2 * np.eye(6))


def points(seed: int, n: int = 40) -> np.ndarray:
    return np.random.default_rng(seed).normal(0, 5, (n, 3))


@given(T=TRANSFORMS, scale=st.floats(0.2, 5.0))
def test_the_similarity_that_moved_points_is_found(T, scale):
    there = scale * points(1) @ T[:3, :3].T + T[:3, 3]
    found = fit_points(points(1), there, scaled=True)
    np.testing.assert_allclose(found.T_to_from, T, atol=1e-9)
    assert found.scale == pytest.approx(scale, rel=1e-9)
    assert fit_points(points(1), there).scale == 1.0


def test_points_in_one_place_are_not_scaled_and_a_straight_path_is_not_turned_about_itself():
    here, there = np.ones((5, 3)), np.full((5, 3), 3.0)
    found = fit_points(here, there, scaled=True)
    assert found.scale == 1.0
    np.testing.assert_allclose(se3.apply(found.T_to_from, here), there)
    poses = np.tile(np.eye(4), (30, 1, 1))
    poses[:, 2, 3] = np.arange(30)
    T = se3.make_transform(se3.exp_so3(np.array([0.1, 0.2, 1.0])), np.array([4.0, 5.0, 6.0]))
    truth = Trajectory(poses, np.arange(30.0))
    found = fit_paths(Trajectory(T @ poses, np.arange(30.0)), truth)
    assert se3.angle_rad(found.T_to_from @ T) < 1e-9
    poses = np.tile(np.eye(4), (3, 1, 1))
    poses[:, 0, 3] = [0, 1, 2]
    T = se3.make_transform(se3.exp_so3(np.array([0.0, 0.0, np.pi / 2])), np.zeros(3))
    moved = Similarity(T, 3.0).move(Trajectory(poses, np.arange(3.0)))
    np.testing.assert_allclose(moved.positions_m[:, 1], [0, 3, 6], atol=1e-12)
    np.testing.assert_allclose(moved.T_world_camera[1, :3, :3], T[:3, :3], atol=1e-12)


def test_places_decide_more_the_wider_a_path_winds():
    turns = []
    for reach_m in (1.0, 30.0, 1000.0):
        poses = np.tile(np.eye(4), (60, 1, 1))
        poses[:, :3, 3] = np.random.default_rng(4).normal(0, reach_m, (60, 3))
        tilted = poses.copy()
        tilted[:, :3, :3] = se3.exp_so3(np.array([0.02, 0.0, 0.0]))
        times = np.arange(60.0)
        found = fit_paths(Trajectory(tilted, times), Trajectory(poses, times))
        turns.append(float(se3.angle_rad(found.T_to_from)))
    assert 0.019 < turns[0] < 0.02
    assert turns[0] > turns[1] > turns[2]
    assert turns[2] < 0.02 / 100


@pytest.mark.parametrize("wrong", [0, 1, 17])
def test_points_that_contradict_more_than_half_are_found(wrong):
    random = np.random.default_rng(8)
    along = np.column_stack([np.arange(40.0), np.zeros((40, 2))])  # straight: the hardest case
    T = se3.make_transform(se3.exp_so3(np.array([0.0, 0.0, 2.0])), np.array([5e5, 5e6, 100.0]))
    there = along @ T[:3, :3].T + T[:3, 3] + random.normal(0, 0.02, (40, 3))
    bad = random.permutation(40)[:wrong]
    there[bad] += random.choice([-1, 1], (wrong, 3)) * random.uniform(2, 50, (wrong, 3))
    np.testing.assert_array_equal(np.flatnonzero(~find_agreeing(along, there, 0.4)), np.sort(bad))
    # Three points cannot outvote one another.
    assert find_agreeing(points(1, 3), points(2, 3), 0.1).all()


NAN = float("nan")
CAMERAS = st.builds(
    RectifiedCamera,
    focal_px=st.floats(100, 4000),
    cx_px=st.floats(0, 1000),
    cy_px=st.floats(0, 1000),
    cx_right_px=st.floats(0, 1000),
    baseline_m=st.floats(0.01, 2),
    width_px=st.just(1000),
    height_px=st.just(1000),
)
CAMERA = RectifiedCamera(721.5, 609.6, 172.9, 609.6, 0.537, 1242, 375)


@given(camera=CAMERAS, depth_m=st.floats(0.5, 200))
def test_depth_and_disparity_are_inverse(camera, depth_m):
    fb = camera.focal_px * camera.baseline_m
    disparity = fb / depth_m - camera.doffs_px
    found = disparity_from_depth(np.array([depth_m]), camera)
    assert found[0] == pytest.approx(disparity, rel=1e-6, abs=1e-4)
    # In float64: float32 of a disparity beside a large doffs loses digits of the depth.
    back = depth_from_disparity(np.array([disparity]), camera)
    assert (back.dtype, back[0]) == (np.float32, pytest.approx(depth_m, rel=1e-5))


@pytest.mark.parametrize("doffs_px", [0.0, 20.0, -20.0])
def test_what_is_unknown_or_not_in_front_has_no_depth_and_warns_of_nothing(doffs_px):
    camera = replace(CAMERA, cx_right_px=CAMERA.cx_px + doffs_px)
    disparity = np.array([NAN, -doffs_px, -doffs_px - 5, np.inf * -1, -doffs_px + 5])
    with np.errstate(all="raise"):
        depth = depth_from_disparity(disparity, camera)
        unknown = disparity_from_depth(np.array([NAN, 0.0, -1.0, 2.0]), camera)
    assert np.isnan(depth).tolist() == [True, True, True, True, False]
    assert np.isnan(unknown).tolist() == [True, True, True, False]


@pytest.mark.parametrize("depth_m", [3.0, 10.0, 30.0])
@pytest.mark.parametrize("sigma_px", [0.1, 0.3])
def test_sigma_is_what_noise_of_disparity_does_to_depth(depth_m, sigma_px):
    rng = np.random.default_rng(0)
    true = disparity_from_depth(np.array([depth_m]), CAMERA).astype(np.float64)
    measured = depth_from_disparity(true + rng.normal(0, sigma_px, 200_000), CAMERA)
    predicted, unknown = depth_sigma(np.array([depth_m, NAN]), sigma_px, CAMERA)
    # 200 000 draws tell a deviation to 0.16 %; the second order of 1/d adds at most
    # (sigma_d / d)² ≈ 0.05 %.
    assert 0.99 < measured.std() / predicted < 1.01
    assert np.isnan(unknown)


@given(camera=CAMERAS, seed=st.integers(0, 1000))
def test_a_pixel_with_depth_is_a_point_and_back(camera, seed):
    rng = np.random.default_rng(seed)
    u, v, depth = rng.uniform(0, 1000, 30), rng.uniform(0, 1000, 30), rng.uniform(0.5, 100, 30)
    xyz = unproject(u, v, depth, camera)
    np.testing.assert_allclose(xyz[:, 2], depth)
    columns, rows, disparity = project(xyz, camera)
    np.testing.assert_allclose(columns, u, rtol=0, atol=1e-9)
    np.testing.assert_allclose(rows, v, rtol=0, atol=1e-9)
    # Where the right camera sees the point: x - b in its own axes.
    right = camera.focal_px * (xyz[:, 0] - camera.baseline_m) / depth + camera.cx_right_px
    np.testing.assert_allclose(u - disparity, right, rtol=0, atol=1e-9)


@pytest.mark.parametrize("dtype", [np.float32, np.float64])
def test_the_principal_point_looks_straight_ahead_right_is_x_and_down_is_y(dtype):
    u, v = CAMERA.cx_px + np.array([0, 10, 0]), CAMERA.cy_px + np.array([0, 0, 10])
    xyz = unproject(u, v, np.ones(3, dtype), CAMERA)
    assert xyz.dtype == dtype
    np.testing.assert_allclose(np.sign(xyz), [[0, 0, 1], [1, 0, 1], [0, 1, 1]])
    # Points behind the camera have no pixel.
    for values in project(np.array([[0.0, 0, -1], [0, 0, 0], [0, 0, 1]]), CAMERA):
        assert np.isnan(values).tolist() == [True, True, False]


def _square(z: float, half: float = 1.0) -> np.ndarray:
    a, b, c, d = ([-half, -half, z], [half, -half, z], [half, half, z], [-half, half, z])
    return np.array([[a, b, c], [a, c, d]])


@pytest.fixture(scope="module")
def scene():
    return RayScene(np.concatenate([_square(2.0), _square(5.0, 3.0)]))


def test_rays_hit_the_nearest_triangle_and_segments_are_blocked_between_their_ends(scene):
    rays = np.array([[0.3, 0.1, 1.0], [-0.1, 0.3, 1.0], [0.55, 0.1, 1.0], [0, 0, -1.0], [5, 0, 1]])
    hits = scene.first_hit(np.zeros(3), rays)
    assert (hits.dtype, hits.tolist()) == (np.int32, [0, 1, 2, -1, -1])
    assert scene.first_hit(np.array([0.0, 0.0, 9.0]), np.array([[0.2, 0.1, -4.0]]))[0] in (2, 3)
    assert scene.first_hit(np.zeros(3), np.empty((0, 3))).shape == (0,)
    far = scene.reach(np.zeros(3), rays)
    np.testing.assert_allclose(far, [2, 2, 5, np.inf, np.inf], rtol=1e-6)
    reach = np.array([[0.0, 0.1, 1.9], [0.0, 0.1, 2.1], [0.0, 0.1, 4.0]])
    assert scene.blocked(np.zeros(3), reach).tolist() == [False, True, True]
    assert scene.blocked(np.zeros(3), reach, far=0.45).tolist() == [False, False, False]
    starts = np.array([[0.0, 0.1, 0.0], [0.0, 0.1, 3.0]])
    assert scene.blocked(starts, np.array([[0, 0, 2.5], [0, 0, 1.5]])).tolist() == [True, False]
    triangles = _square(1.0).astype(np.float32)
    rays = np.array([[0.1, 0.0, 1.0]], dtype=np.float32)
    for array in (triangles, rays):
        array.flags.writeable = False
    assert RayScene(triangles).first_hit(np.zeros(3), rays)[0] >= 0
    rng = np.random.default_rng(0)
    triangles = rng.uniform(-5, 5, (400, 1, 3)) + rng.normal(0, 0.4, (400, 3, 3))
    rays = rng.normal(size=(3000, 3))
    one, many = (RayScene(triangles, n).first_hit(np.zeros(3), rays) for n in (1, 0))
    assert (one >= 0).any()
    assert np.array_equal(one, many)


@pytest.mark.parametrize(
    "broken", [np.empty((0, 3, 3)), np.zeros((4, 3)), np.full((1, 3, 3), np.nan)]
)
def test_bad_triangles_are_refused(broken):
    with pytest.raises(ShapeError):
        RayScene(broken)
