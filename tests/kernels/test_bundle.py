"""The compiled adjustment equals its twin, and its derivatives are those of its residuals."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from recon.geometry.se3 import exp_so3, invert, make_transform
from recon.kernels.bundle import BundleModel, cost, linearise, solve_step
from recon.kernels.bundle_reference import (
    cost_reference,
    linearise_reference,
    solve_step_reference,
)

MODEL = BundleModel(
    focal=300.0, cx=200.0, cy=90.0, fb=150.0, doffs=3.0, sigma_uv=0.3, sigma_d=1.5, cauchy=3.0
)

Window = tuple[np.ndarray, np.ndarray, np.ndarray]


def make_window(seed: int, frames: int, points: int, seen_share: float = 0.7) -> Window:
    """Poses, observations with noise, holes and outliers, and points; some behind the camera."""
    rng = np.random.default_rng(seed)
    poses = np.stack(
        [
            make_transform(exp_so3(0.05 * rng.normal(size=3)), [*0.1 * rng.normal(size=2), 0.4 * w])
            for w in range(frames)
        ]
    )
    xyz = rng.uniform([-5, -3, -1], [5, 2, 30], (points, 3))
    T = invert(poses)
    places = np.einsum("wij,nj->wni", T[:, :3, :3], xyz) + T[:, None, :3, 3]
    z = np.maximum(places[:, :, 2], 0.1)
    uvd = np.stack(
        [300 * places[:, :, 0] / z + 200, 300 * places[:, :, 1] / z + 90, 150 / z - 3], axis=-1
    )
    uvd += (
        rng.normal(0, 0.5, uvd.shape) * np.where(rng.random(uvd.shape[:2]) < 0.1, 40, 1)[..., None]
    )
    uvd[rng.random(uvd.shape[:2]) > seen_share] = np.nan
    uvd[rng.random(uvd.shape[:2]) < 0.2, 2] = np.nan
    return T, uvd, xyz


windows = st.builds(
    make_window,
    seed=st.integers(0, 2**20),
    frames=st.integers(1, 5),
    points=st.integers(0, 25),
    seen_share=st.sampled_from([0.0, 0.5, 1.0]),
)


@given(windows)
@settings(max_examples=60, deadline=None)
def test_normal_equations_equal_their_twin(window: Window) -> None:
    for ours, twin in zip(
        linearise(*window, MODEL), linearise_reference(*window, MODEL), strict=True
    ):
        # Sums in another order: rounding alone, relative to the largest entry.
        scale = max(1.0, float(np.abs(twin).max(initial=0.0)))
        np.testing.assert_allclose(ours, twin, rtol=1e-9, atol=1e-11 * scale)


@given(windows)
@settings(max_examples=60, deadline=None)
def test_cost_equals_its_twin(window: Window) -> None:
    assert cost(*window, tuple(MODEL)) == pytest.approx(cost_reference(*window, MODEL), rel=1e-12)


@given(st.integers(0, 2**20), st.integers(2, 4), st.sampled_from([1e-4, 1e-1]))
@settings(max_examples=40, deadline=None)
def test_reduced_step_equals_that_of_the_whole_system(
    seed: int, frames: int, damping: float
) -> None:
    normal = linearise(*make_window(seed, frames, points=25), MODEL)
    for ours, twin in zip(
        solve_step(normal, damping), solve_step_reference(normal, damping), strict=True
    ):
        # Points seen once are all but free along their ray: large steps, poorly conditioned.
        np.testing.assert_allclose(ours, twin, rtol=1e-4, atol=1e-6 * max(1.0, np.abs(twin).max()))


def test_the_first_pose_does_not_step() -> None:
    step_pose, _ = solve_step(linearise(*make_window(3, 4, 25), MODEL), 1e-4)
    assert not step_pose[0].any()
    assert step_pose[1:].all()


def test_an_empty_system_makes_no_step() -> None:
    step_pose, step_point = solve_step(linearise(*make_window(3, 3, 0), MODEL), 1e-4)
    assert not step_pose.any()
    assert step_point.shape == (0, 3)


def test_gradient_is_the_slope_of_the_cost() -> None:
    """Central differences along each coordinate of a pose and of a point."""
    T, uvd, xyz = make_window(5, 3, 20)
    keep = np.einsum("j,nj->n", T[0, 2, :3], xyz) > 3.0
    uvd, xyz = uvd[:, keep], xyz[keep]
    normal = linearise(T, uvd, xyz, MODEL)
    e = 1e-6
    for i in range(6):
        step = np.zeros(6)
        step[i] = e
        moved = []
        for sign in (1, -1):
            M = make_transform(exp_so3(sign * step[3:]), sign * step[:3])
            poses = T.copy()
            poses[1] = invert(invert(T[1]) @ M)
            moved.append(cost(poses, uvd, xyz, tuple(MODEL)))
        # d log1p(r²/c²) = 2·w·r·dr/c²; g sums -w·J·r with r = observed - predicted.
        slope = (moved[0] - moved[1]) / (2 * e)
        assert slope == pytest.approx(
            -2 * normal.g_pose[1, i] / MODEL.cauchy**2, rel=1e-4, abs=1e-3
        )
    for i in range(3):
        shifted = []
        for sign in (1, -1):
            points = xyz.copy()
            points[0, i] += sign * e
            shifted.append(cost(T, uvd, points, tuple(MODEL)))
        slope = (shifted[0] - shifted[1]) / (2 * e)
        assert slope == pytest.approx(
            -2 * normal.g_point[0, i] / MODEL.cauchy**2, rel=1e-4, abs=1e-3
        )
