"""The compiled adjustment equals its reference, and its derivatives are those of its residuals."""

from typing import NamedTuple

import numpy as np
import pytest
from hypothesis import example, given, settings
from hypothesis import strategies as st
from numpy.typing import NDArray

from recon.core.geometry.se3 import exp_so3, invert, make_transform
from recon.odometry.kernels.bundle import (
    MIN_DEPTH_M,
    RIDGE,
    BundleModel,
    NormalEquations,
    cost,
    linearise,
    solve_step,
)

MODEL = BundleModel(
    focal=300.0, cx=200.0, cy=90.0, fb=150.0, doffs=3.0, sigma_uv=0.3, sigma_d=1.5, cauchy=3.0
)

Window = tuple[np.ndarray, np.ndarray, np.ndarray]


def make_window(seed: int, frames: int, points: int, seen_share: float = 0.7) -> Window:
    """Poses, observations with noise, holes and outliers, and points; some behind the camera."""
    rng = np.random.default_rng(seed)
    poses = [
        make_transform(exp_so3(0.05 * rng.normal(size=3)), [*0.1 * rng.normal(size=2), 0.4 * w])
        for w in range(frames)
    ]
    xyz = rng.uniform([-5, -3, -1], [5, 2, 30], (points, 3))
    T = invert(np.stack(poses))
    places = np.einsum("wij,nj->wni", T[:, :3, :3], xyz) + T[:, None, :3, 3]
    z = np.maximum(places[:, :, 2], 0.1)
    u, v = 300 * places[:, :, 0] / z + 200, 300 * places[:, :, 1] / z + 90
    uvd = np.stack([u, v, 150 / z - 3], axis=-1)
    noise = rng.normal(0, 0.5, uvd.shape)
    uvd += noise * np.where(rng.random(uvd.shape[:2]) < 0.1, 40, 1)[..., None]
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


U = 2.0**-53  # rounding of one operation, as a share of its result (float64)


class Magnitudes(NamedTuple):
    """What the roundings of an observation are shares of: sums of absolute values, all terms.

    A residual that all but vanishes is the difference of two columns of thousands of pixels, and
    keeps their rounding; so relative to itself there is no bound.
    """

    residual: np.ndarray  # (W, N, 3), in standard deviations; 0 where not seen
    camera: np.ndarray  # (W, N, 3, 3), of the derivatives by the point in camera axes
    place: np.ndarray  # (W, N, 3), of the point in camera axes


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
    entries = summed((pose, J_pose), (point, J_point), size.residual)
    return NormalEquations(*(2 * U * entry for entry in entries))


@given(windows)
@settings(max_examples=60)
def test_normal_equations_equal_their_reference(window):
    ours, reference = linearise(*window, MODEL), linearise_reference(*window, MODEL)
    bounds = rounding_of_the_normal_equations(window)
    for name in NormalEquations._fields:
        difference = abs(getattr(ours, name) - getattr(reference, name))
        assert (difference <= getattr(bounds, name)).all(), name


@given(windows)
@settings(max_examples=60)
@example(make_window(420, 3, 3, 0.5))  # 1.5e-12 of the cost apart, found by chance
def test_cost_equals_its_reference(window):
    difference = abs(cost(*window, tuple(MODEL)) - cost_reference(*window, MODEL))
    assert difference <= rounding_of_the_cost(window)


def condition(H: np.ndarray) -> float:
    """Of the matrix with its rows and columns scaled to a unit diagonal."""
    d = np.sqrt(np.diag(H))
    return float(np.linalg.cond(H / np.outer(d, d)))


@given(st.integers(0, 2**20), st.integers(2, 4), st.sampled_from([1e-4, 1e-1]))
@settings(max_examples=40)
def test_reduced_step_equals_that_of_the_whole_system(seed, frames, damping):
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


def test_the_first_pose_and_an_empty_system_make_no_step():
    step_pose, _ = solve_step(linearise(*make_window(3, 4, 25), MODEL), 1e-4)
    assert not step_pose[0].any()
    assert step_pose[1:].all()
    step_pose, step_point = solve_step(linearise(*make_window(3, 3, 0), MODEL), 1e-4)
    assert not step_pose.any()
    assert step_point.shape == (0, 3)


def test_gradient_is_the_slope_of_the_cost():
    """Central differences along each coordinate of a pose and of a point."""
    T, uvd, xyz = make_window(5, 3, 20)
    keep = np.einsum("j,nj->n", T[0, 2, :3], xyz) > 3.0
    uvd, xyz = uvd[:, keep], xyz[keep]

    def cost_after(step: np.ndarray) -> float:
        poses, points = T.copy(), xyz.copy()
        poses[1] = invert(invert(T[1]) @ make_transform(exp_so3(step[3:6]), step[:3]))
        points[0] += step[6:]
        return cost(poses, uvd, points, tuple(MODEL))

    normal, e = linearise(T, uvd, xyz, MODEL), 1e-6
    for axis, g in zip(e * np.eye(9), [*normal.g_pose[1], *normal.g_point[0]], strict=True):
        # d log1p(r²/c²) = 2·w·r·dr/c²; g sums -w·J·r with r = observed - predicted.
        slope = (cost_after(axis) - cost_after(-axis)) / (2 * e)
        assert slope == pytest.approx(-2 * g / MODEL.cauchy**2, rel=1e-4, abs=1e-3)


Float64 = NDArray[np.float64]


def linearise_reference(
    T_camera_world: Float64, uvd: Float64, xyz_world: Float64, model: BundleModel
) -> NormalEquations:
    """Reference implementation of `recon.odometry.kernels.bundle.linearise`."""
    white, xyz = _white(T_camera_world, uvd, xyz_world, model)
    weight = 1.0 / (1.0 + np.square(white).sum(axis=2) / model.cauchy**2)
    J_camera = _projection_jacobian(xyz, model) * np.isfinite(uvd)[:, :, :, None]
    J_point = J_camera @ T_camera_world[:, None, :3, :3]
    J_pose = np.concatenate([-J_camera, np.cross(J_camera, xyz[:, :, None, :])], axis=-1)
    pose, point = ((J * weight[:, :, None, None], J) for J in (J_pose, J_point))
    return summed(pose, point, white)


def summed(
    pose: tuple[Float64, Float64], point: tuple[Float64, Float64], residual: Float64
) -> NormalEquations:
    """Sum products of derivatives, weighted and not, and residuals over all observations."""
    return NormalEquations(
        H_pose=np.einsum("wnki,wnkj->wij", *pose),
        g_pose=np.einsum("wnki,wnk->wi", pose[0], residual),
        H_point=np.einsum("wnki,wnkj->nij", *point),
        g_point=np.einsum("wnki,wnk->ni", point[0], residual),
        H_cross=np.einsum("wnki,wnkj->wnij", pose[0], point[1]),
    )


def solve_step_reference(normal: NormalEquations, damping: float) -> tuple[Float64, Float64]:
    """Return the reference of `bundle.solve_step`: the whole system, not reduced."""
    H, g = whole_system(normal, damping)
    step = np.concatenate([np.zeros(6), np.linalg.solve(H[6:, 6:], g[6:])])
    size = 6 * len(normal.H_pose)
    return step[:size].reshape(-1, 6), step[size:].reshape(-1, 3)


def whole_system(normal: NormalEquations, damping: float) -> tuple[Float64, Float64]:
    """The damped equations of all poses, then all points: a matrix and its right-hand side."""
    frames, points = len(normal.H_pose), len(normal.H_point)
    size = 6 * frames
    H = np.zeros((size + 3 * points, size + 3 * points))
    for w, block in enumerate(normal.H_pose):
        H[6 * w : 6 * w + 6, 6 * w : 6 * w + 6] = block
    for n, block in enumerate(normal.H_point):
        at = size + 3 * n
        H[at : at + 3, at : at + 3] = block
        for w in range(frames):
            cross = normal.H_cross[w, n]
            H[6 * w : 6 * w + 6, at : at + 3] = cross
            H[at : at + 3, 6 * w : 6 * w + 6] = cross.T
    H[np.diag_indices_from(H)] += damping * np.diag(H) + RIDGE
    return H, np.concatenate([normal.g_pose.ravel(), normal.g_point.ravel()])


def cost_reference(
    T_camera_world: Float64, uvd: Float64, xyz_world: Float64, model: BundleModel
) -> float:
    """Reference implementation of `recon.odometry.kernels.bundle.cost`."""
    white, _ = _white(T_camera_world, uvd, xyz_world, model)
    return float(np.log1p(np.square(white).sum(axis=2) / model.cauchy**2).sum())


def _white(
    T_camera_world: Float64, uvd: Float64, xyz_world: Float64, model: BundleModel
) -> tuple[Float64, Float64]:
    """Residuals in standard deviations (W, N, 3), 0 where not seen; points in camera axes."""
    xyz = np.einsum("wij,nj->wni", T_camera_world[:, :3, :3], xyz_world)
    xyz += T_camera_world[:, None, :3, 3]
    z = np.maximum(xyz[:, :, 2], MIN_DEPTH_M)
    u, v = (model.focal * xyz[:, :, k] / z + c for k, c in enumerate((model.cx, model.cy)))
    predicted = np.stack([u, v, model.fb / z - model.doffs], axis=-1)
    sigmas = np.array([model.sigma_uv, model.sigma_uv, model.sigma_d])
    return np.where(np.isfinite(uvd), (uvd - predicted) / sigmas, 0.0), xyz


def _projection_jacobian(xyz: Float64, model: BundleModel) -> Float64:
    """Return whitened derivative (W, N, 3, 3) of column, row and disparity by the point."""
    z = np.maximum(xyz[:, :, 2], MIN_DEPTH_M)
    J = np.zeros((*xyz.shape, 3))
    J[:, :, 0, 0] = J[:, :, 1, 1] = model.focal / z / model.sigma_uv
    J[:, :, 0, 2] = -model.focal * xyz[:, :, 0] / z**2 / model.sigma_uv
    J[:, :, 1, 2] = -model.focal * xyz[:, :, 1] / z**2 / model.sigma_uv
    J[:, :, 2, 2] = -model.fb / z**2 / model.sigma_d
    return J
