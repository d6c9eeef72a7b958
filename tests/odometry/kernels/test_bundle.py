"""The compiled adjustment equals its reference, and its derivatives are those of its residuals."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
import pytest
from hypothesis import example, given, settings
from hypothesis import strategies as st

from recon.core.geometry.se3 import exp_so3, invert, make_transform
from recon.odometry.kernels.bundle import (
    MIN_DEPTH_M,
    BundleModel,
    NormalEquations,
    cost,
    linearise,
    solve_step,
)
from tests.odometry.kernels.bundle_reference import (
    cost_reference,
    linearise_reference,
    solve_step_reference,
    whole_system,
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


U = 2.0**-53
"""Rounding of one operation, as a share of its result (float64)."""


class Magnitudes(NamedTuple):
    """What the roundings of an observation are shares of: sums of absolute values, all terms.

    A residual that all but vanishes is the difference of two columns of thousands of pixels, and
    keeps their rounding; so relative to itself there is no bound.
    """

    residual: np.ndarray
    """(W, N, 3), in standard deviations; 0 where not seen."""
    camera: np.ndarray
    """(W, N, 3, 3), of the derivatives by the point in camera axes."""
    place: np.ndarray
    """(W, N, 3), of the point in camera axes."""


def magnitudes(window: Window) -> Magnitudes:
    T, uvd, xyz = window
    m = MODEL
    size = np.einsum("wij,nj->wni", abs(T[:, :3, :3]), abs(xyz)) + abs(T[:, None, :3, 3])
    place = np.einsum("wij,nj->wni", T[:, :3, :3], xyz) + T[:, None, :3, 3]
    z = np.maximum(place[:, :, 2], MIN_DEPTH_M)
    # A depth near zero is the difference of large terms: what is divided by it keeps their share.
    steep = np.maximum(size[:, :, 2] / z, 1)
    column, row = (m.focal * size[:, :, i] / z * steep for i in range(2))
    disparity = m.fb / z * steep
    predicted = np.stack([column + m.cx, row + m.cy, disparity + m.doffs], axis=-1)
    sigmas = np.array([m.sigma_uv, m.sigma_uv, m.sigma_d])
    camera = np.zeros((*z.shape, 3, 3))
    camera[:, :, 0, 0] = camera[:, :, 1, 1] = m.focal / z * steep
    camera[:, :, :, 2] = np.stack([column, row, disparity], axis=-1) / z[..., None]
    seen = np.isfinite(uvd)
    return Magnitudes(
        np.where(seen, (abs(uvd) + predicted) / sigmas, 0),
        camera / sigmas[:, None] * seen[..., None],
        size,
    )


def rounding_of_the_cost(window: Window) -> float:
    """How far two ways to add up the cost may differ.

    A residual is the result of at most 10 operations on its magnitudes: 4 for the place, 5 for the
    division, the focal length, the principal point, the difference and sigma, 1 for the depth.
    The cost log1p(r²/c²) changes by at most 1/c per unit of r. Squares, their sum, the quotient
    and the logarithm (2) are 8 operations of it, and the sum of n costs n. Each way may err.
    """
    residuals = magnitudes(window).residual
    terms = residuals.shape[0] * residuals.shape[1]
    by_residuals = 10 * residuals.sum() / MODEL.cauchy
    return 2 * U * (by_residuals + (terms + 8) * cost_reference(*window, MODEL))


def rounding_of_the_normal_equations(window: Window) -> NormalEquations:
    """How far two ways to add up the equations may differ, entry by entry.

    With derivatives J (at most 20 operations each, those of the place and of the turn included)
    and weights w: the terms w·J·J and w·J·r err by their magnitude times 2 · 20 and 20 + 10
    operations, times those of the sum, plus what the weight errs by: 2/c per unit of r at most,
    and 8 operations of its own. A weight is at most 1.
    """
    size = magnitudes(window)
    J_point = size.camera @ abs(window[0][:, None, :3, :3])
    x, y, z = np.moveaxis(size.place[:, :, None, :], -1, 0)
    by_x, by_y, by_z = np.moveaxis(size.camera, -1, 0)
    turned = np.stack([by_y * z + by_z * y, by_z * x + by_x * z, by_x * y + by_y * x], axis=-1)
    J_pose = np.concatenate([size.camera, turned], axis=-1)
    weight_errs = 2 * 10 * size.residual.sum(axis=2) / MODEL.cauchy + 8
    operations = 2 * 20 + size.residual.shape[0] * size.residual.shape[1] + weight_errs
    pose, point = (J * operations[:, :, None, None] for J in (J_pose, J_point))
    r = size.residual
    entries = NormalEquations(
        H_pose=np.einsum("wnki,wnkj->wij", pose, J_pose),
        g_pose=np.einsum("wnki,wnk->wi", pose, r),
        H_point=np.einsum("wnki,wnkj->nij", point, J_point),
        g_point=np.einsum("wnki,wnk->ni", point, r),
        H_cross=np.einsum("wnki,wnkj->wnij", pose, J_point),
    )
    return NormalEquations(*(2 * U * entry for entry in entries))


@given(windows)
@settings(max_examples=60)
def test_normal_equations_equal_their_reference(window: Window) -> None:
    ours, reference = linearise(*window, MODEL), linearise_reference(*window, MODEL)
    bounds = rounding_of_the_normal_equations(window)
    for name in NormalEquations._fields:
        difference = abs(getattr(ours, name) - getattr(reference, name))
        assert (difference <= getattr(bounds, name)).all(), name


@given(windows)
@settings(max_examples=60)
@example(make_window(420, 3, 3, 0.5))  # 1.5e-12 of the cost apart, found by chance
def test_cost_equals_its_reference(window: Window) -> None:
    difference = abs(cost(*window, tuple(MODEL)) - cost_reference(*window, MODEL))
    assert difference <= rounding_of_the_cost(window)


def condition(H: np.ndarray) -> float:
    """Of the matrix with its rows and columns scaled to a unit diagonal."""
    d = np.sqrt(np.diag(H))
    return float(np.linalg.cond(H / np.outer(d, d)))


@given(st.integers(0, 2**20), st.integers(2, 4), st.sampled_from([1e-4, 1e-1]))
@settings(max_examples=40)
def test_reduced_step_equals_that_of_the_whole_system(
    seed: int, frames: int, damping: float
) -> None:
    normal = linearise(*make_window(seed, frames, points=25), MODEL)
    H, g = whole_system(normal, damping)
    ours = np.concatenate([part.ravel() for part in solve_step(normal, damping)])
    reference = np.concatenate([part.ravel() for part in solve_step_reference(normal, damping)])
    scale = np.sqrt(np.diag(H))[6:]

    def left_over(step: np.ndarray) -> float:
        return float(np.linalg.norm((H[6:, 6:] @ step[6:] - g[6:]) / scale))

    # Cofactors of a point's block are differences of products that may be larger by its condition,
    # which damping bounds by 3 / damping (the trace over the least eigenvalue, scaled): the step
    # solves the system up to 40 operations (block, its inverse, the folded sums) times that.
    size = np.linalg.norm(g[6:] / scale) + np.linalg.norm(scale * ours[6:])
    assert left_over(ours) <= 40 * U * 3 / damping * size
    # What both leave over (numpy's more, as the system is not scaled), and the sums of 100 terms
    # that it is computed with here, become an error of the step through the condition.
    error = np.linalg.norm(scale * (ours - reference)[6:])
    unsolved = left_over(ours) + left_over(reference) + 2 * 100 * U * size
    assert error <= condition(H[6:, 6:]) * unsolved


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
