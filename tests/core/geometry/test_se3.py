from __future__ import annotations

import math

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from recon.core.geometry.se3 import (
    angle_rad,
    apply,
    as_step,
    as_transform,
    exp_so3,
    hat,
    invert,
    log_so3,
    make_transform,
    orthonormalise,
    quaternion_from_rotation,
    rotate,
    rotation_from_quaternion,
    step_jacobian,
)

VECTORS = st.tuples(*[st.floats(-3, 3)] * 3).map(np.array)
ROTATIONS = VECTORS.map(exp_so3)
TRANSFORMS = st.builds(make_transform, ROTATIONS, VECTORS)
POINTS = np.random.default_rng(0).uniform(-10, 10, (20, 3))

# float64 on numbers up to about 20.
EXACT = {"rtol": 0, "atol": 1e-12}


@given(T=TRANSFORMS)
def test_a_transform_times_its_inverse_is_the_identity(T: np.ndarray) -> None:
    np.testing.assert_allclose(T @ invert(T), np.eye(4), **EXACT)
    np.testing.assert_allclose(invert(invert(T)), T, **EXACT)


@given(A=TRANSFORMS, B=TRANSFORMS)
def test_a_stack_is_inverted_like_its_members(A: np.ndarray, B: np.ndarray) -> None:
    np.testing.assert_array_equal(invert(np.stack([A, B])), np.stack([invert(A), invert(B)]))


@given(T_a_b=TRANSFORMS, T_b_c=TRANSFORMS)
def test_neighbouring_frames_cancel(T_a_b: np.ndarray, T_b_c: np.ndarray) -> None:
    np.testing.assert_allclose(
        apply(T_a_b @ T_b_c, POINTS), apply(T_a_b, apply(T_b_c, POINTS)), **EXACT
    )


@given(T=TRANSFORMS)
def test_a_rigid_motion_keeps_distances_and_turns_directions(T: np.ndarray) -> None:
    moved = apply(T, POINTS)
    np.testing.assert_allclose(
        np.linalg.norm(np.diff(moved, axis=0), axis=1),
        np.linalg.norm(np.diff(POINTS, axis=0), axis=1),
        **EXACT,
    )
    np.testing.assert_allclose(rotate(T, POINTS), moved - T[:3, 3], **EXACT)


def test_points_keep_their_floating_dtype() -> None:
    for dtype in (np.float32, np.float64):
        assert apply(np.eye(4), POINTS.astype(dtype)).dtype == dtype
        assert rotate(np.eye(4), POINTS.astype(dtype)).dtype == dtype


@given(w=VECTORS)
def test_exp_gives_a_rotation_about_w_by_its_length(w: np.ndarray) -> None:
    R = exp_so3(w)
    np.testing.assert_allclose(R @ R.T, np.eye(3), **EXACT)
    np.testing.assert_allclose(R @ w, w, **EXACT)
    angle = np.linalg.norm(w) % (2 * np.pi)
    # Near half a turn the sine is small, and its square root of rounding shows.
    np.testing.assert_allclose(
        angle_rad(make_transform(R, np.zeros(3))), min(angle, 2 * np.pi - angle), atol=1e-9
    )


@given(w=VECTORS, scale=st.floats(1e-12, 1e-6))
def test_exp_of_a_small_turn_is_its_first_order(w: np.ndarray, scale: float) -> None:
    # The rest is of second order: |w·scale|² / 2 < 1.5e-11.
    np.testing.assert_allclose(exp_so3(w * scale), np.eye(3) + hat(w * scale), rtol=0, atol=2e-11)


@given(w=VECTORS)
def test_exp_of_the_opposite_turn_is_the_inverse(w: np.ndarray) -> None:
    np.testing.assert_allclose(exp_so3(-w), exp_so3(w).T, **EXACT)


@given(w=VECTORS, v=VECTORS)
def test_hat_is_the_cross_product(w: np.ndarray, v: np.ndarray) -> None:
    np.testing.assert_allclose(hat(w) @ v, np.cross(w, v), **EXACT)


@given(st.lists(st.floats(-1.5, 1.5), min_size=6, max_size=6))
def test_steps_and_transforms_are_inverse(step: list[float]) -> None:
    # sqrt(3)·1.5 < π, so the rotation vector is unique.
    np.testing.assert_allclose(as_step(as_transform(np.array(step))), step, atol=1e-9)


def test_the_jacobian_of_a_step_is_the_derivative_of_moved_points() -> None:
    xyz, h = np.random.default_rng(3).normal(0.0, 5.0, (7, 3)), 1e-6
    for axis, step in enumerate(h * np.eye(6)):
        moved = (apply(as_transform(step), xyz) - apply(as_transform(-step), xyz)) / (2 * h)
        # The third derivative, |xyz|·h², and rounding, |xyz|·2⁻⁵²/h: both far below 1e-7.
        np.testing.assert_allclose(step_jacobian(xyz)[:, :, axis], moved, rtol=0, atol=1e-7)


def test_angles_keep_their_precision_where_acos_loses_it() -> None:
    for angle in (1e-9, 1e-5, 1.0, np.pi - 1e-9):
        T = make_transform(exp_so3(np.array([0, angle, 0])), np.zeros(3))
        # acos of the trace would be off by 1e-8.
        np.testing.assert_allclose(angle_rad(T), angle, rtol=0, atol=1e-15 + 1e-14 * angle)


@given(T=TRANSFORMS, noise=st.integers(0, 1000))
def test_orthonormalising_mends_small_noise(T: np.ndarray, noise: int) -> None:
    rough = T.copy()
    rough[:3, :3] += np.random.default_rng(noise).uniform(-1e-4, 1e-4, (3, 3))
    mended = orthonormalise(rough)
    np.testing.assert_allclose(mended[:3, :3] @ mended[:3, :3].T, np.eye(3), **EXACT)
    assert np.linalg.det(mended[:3, :3]) > 0
    # The nearest rotation is no further from the noisy matrix than the one it came from.
    gaps = [np.linalg.norm(rough[:3, :3] - R[:3, :3]) for R in (mended, T)]
    assert gaps[0] <= gaps[1] + 1e-12
    np.testing.assert_array_equal(mended[:3, 3], T[:3, 3])


@given(R=ROTATIONS)
def test_a_rotation_comes_back_from_its_quaternion(R: np.ndarray) -> None:
    xyzw = quaternion_from_rotation(R)
    np.testing.assert_allclose(np.linalg.norm(xyzw), 1, **EXACT)
    assert xyzw[3] >= 0
    np.testing.assert_allclose(rotation_from_quaternion(xyzw), R, **EXACT)


@given(xyzw=st.tuples(*[st.floats(-1, 1)] * 4).map(np.array))
def test_the_length_and_sign_of_a_quaternion_do_not_matter(xyzw: np.ndarray) -> None:
    if np.linalg.norm(xyzw) < 1e-3:
        return
    R = rotation_from_quaternion(xyzw)
    np.testing.assert_allclose(R @ R.T, np.eye(3), **EXACT)
    np.testing.assert_allclose(rotation_from_quaternion(-3 * xyzw), R, **EXACT)


def test_half_turns_have_a_quaternion() -> None:
    for axis in np.eye(3):
        R = exp_so3(np.pi * axis)
        np.testing.assert_allclose(np.abs(quaternion_from_rotation(R)[:3]), axis, **EXACT)


DIRECTIONS = st.lists(st.floats(-1, 1), min_size=3, max_size=3).filter(
    lambda v: float(np.linalg.norm(v)) > 0.1
)


@given(direction=DIRECTIONS, angle=st.floats(0.0, math.pi - 1e-6))
def test_log_is_the_inverse_of_exp(direction: list[float], angle: float) -> None:
    w = angle * np.array(direction) / np.linalg.norm(direction)
    # 1e-7: near π the rotation vector amplifies the matrix's rounding by its square root.
    np.testing.assert_allclose(log_so3(exp_so3(w)), w, atol=1e-7)


@pytest.mark.parametrize("axis", np.eye(3))
def test_half_a_turn_has_an_axis(axis: np.ndarray) -> None:
    R = 2.0 * np.outer(axis, axis) - np.eye(3)
    w = log_so3(R)
    assert np.linalg.norm(w) == pytest.approx(math.pi)
    np.testing.assert_allclose(exp_so3(w), R, atol=1e-12)
