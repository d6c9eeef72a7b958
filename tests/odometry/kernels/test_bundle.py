"""The compiled adjustment equals its reference, and its derivatives are those of its residuals."""

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from numpy.typing import NDArray

from recon.core.geometry.se3 import exp_so3, invert, make_transform
from recon.odometry.kernels import bundle

MODEL = bundle.BundleModel(
    focal=300.0, cx=200.0, cy=90.0, fb=150.0, doffs=3.0, sigma_uv=0.3, sigma_d=1.5, cauchy=3.0
)

Window = tuple[np.ndarray, np.ndarray, np.ndarray]


def make_window(seed: int, frames: int, points: int, seen_ratio: float = 0.7) -> Window:
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
    uvd[rng.random(uvd.shape[:2]) > seen_ratio] = np.nan
    uvd[rng.random(uvd.shape[:2]) < 0.2, 2] = np.nan
    return T, uvd, xyz


windows = st.builds(
    make_window,
    seed=st.integers(0, 2**20),
    frames=st.integers(1, 5),
    points=st.integers(0, 25),
    seen_ratio=st.sampled_from([0.0, 0.5, 1.0]),
)


# float64: sums of some hundred terms in another order, with depths of at least `NEAREST`.
ROUNDING = 1e-9


@given(windows)
@settings(max_examples=60)
def test_normal_equations_and_cost_equal_their_references(window):
    ours, reference = bundle.linearise(*window, MODEL), linearise_reference(*window, MODEL)
    for name in bundle.NormalEquations._fields:
        expected = getattr(reference, name)
        atol = ROUNDING * abs(expected).max(initial=0.0)
        np.testing.assert_allclose(getattr(ours, name), expected, rtol=0, atol=atol, err_msg=name)
    expected = cost_reference(*window, MODEL)
    assert bundle.cost(*window, tuple(MODEL)) == pytest.approx(expected, rel=ROUNDING)


@given(st.integers(0, 2**20), st.integers(2, 4), st.sampled_from([1e-4, 1e-1]))
@settings(max_examples=40)
def test_reduced_step_solves_the_whole_system(seed, frames, damping):
    normal = bundle.linearise(*make_window(seed, frames, points=25), MODEL)
    H, g = whole_system(normal, damping)
    step = np.concatenate([part.ravel() for part in bundle.solve_step(normal, damping)])[6:]
    scale = np.sqrt(np.diag(H))[6:]
    left_over = np.linalg.norm((H[6:, 6:] @ step - g[6:]) / scale)
    # Cofactors of a point's block are differences of products that may be larger by its condition,
    # which damping bounds by 3 / damping (the trace over the least eigenvalue, scaled).
    size = np.linalg.norm(g[6:] / scale) + np.linalg.norm(scale * step)
    assert left_over <= 40 * 2.0**-53 * 3 / damping * size


def test_the_first_pose_and_an_empty_system_make_no_step():
    step_pose, _ = bundle.solve_step(bundle.linearise(*make_window(3, 4, 25), MODEL), 1e-4)
    assert not step_pose[0].any()
    assert step_pose[1:].all()
    step_pose, step_point = bundle.solve_step(bundle.linearise(*make_window(3, 3, 0), MODEL), 1e-4)
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
        return bundle.cost(poses, uvd, points, tuple(MODEL))

    normal, e = bundle.linearise(T, uvd, xyz, MODEL), 1e-6
    for axis, g in zip(e * np.eye(9), [*normal.g_pose[1], *normal.g_point[0]], strict=True):
        # d log1p(r²/c²) = 2·w·r·dr/c²; g sums -w·J·r with r = observed - predicted.
        slope = (cost_after(axis) - cost_after(-axis)) / (2 * e)
        assert slope == pytest.approx(-2 * g / MODEL.cauchy**2, rel=1e-4, abs=1e-3)


Float64 = NDArray[np.float64]


def linearise_reference(T_camera_world, uvd, xyz_world, model):
    white, xyz = _white(T_camera_world, uvd, xyz_world, model)
    weight = 1.0 / (1.0 + np.square(white).sum(axis=2) / model.cauchy**2)
    J_camera = _projection_jacobian(xyz, model) * np.isfinite(uvd)[:, :, :, None]
    J_point = J_camera @ T_camera_world[:, None, :3, :3]
    J_pose = np.concatenate([-J_camera, np.cross(J_camera, xyz[:, :, None, :])], axis=-1)
    pose, point = ((J * weight[:, :, None, None], J) for J in (J_pose, J_point))
    return summed(pose, point, white)


def summed(pose, point, residual):
    """Sum products of derivatives, weighted and not, and residuals over all observations."""
    return bundle.NormalEquations(
        H_pose=np.einsum("wnki,wnkj->wij", *pose),
        g_pose=np.einsum("wnki,wnk->wi", pose[0], residual),
        H_point=np.einsum("wnki,wnkj->nij", *point),
        g_point=np.einsum("wnki,wnk->ni", point[0], residual),
        H_cross=np.einsum("wnki,wnkj->wnij", pose[0], point[1]),
    )


def whole_system(normal: bundle.NormalEquations, damping: float) -> tuple[Float64, Float64]:
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
    H[np.diag_indices_from(H)] += damping * np.diag(H) + bundle.RIDGE
    return H, np.concatenate([normal.g_pose.ravel(), normal.g_point.ravel()])


def cost_reference(T_camera_world, uvd, xyz_world, model):
    white, _ = _white(T_camera_world, uvd, xyz_world, model)
    return float(np.log1p(np.square(white).sum(axis=2) / model.cauchy**2).sum())


def _white(T_camera_world, uvd, xyz_world, model):
    """Residuals in standard deviations (W, N, 3), 0 where not seen; points in camera axes."""
    xyz = np.einsum("wij,nj->wni", T_camera_world[:, :3, :3], xyz_world)
    xyz += T_camera_world[:, None, :3, 3]
    z = np.maximum(xyz[:, :, 2], bundle.NEAREST * model.fb / model.focal)
    u, v = (model.focal * xyz[:, :, k] / z + c for k, c in enumerate((model.cx, model.cy)))
    predicted = np.stack([u, v, model.fb / z - model.doffs], axis=-1)
    sigmas = np.array([model.sigma_uv, model.sigma_uv, model.sigma_d])
    return np.where(np.isfinite(uvd), (uvd - predicted) / sigmas, 0.0), xyz


def _projection_jacobian(xyz: Float64, model: bundle.BundleModel) -> Float64:
    """Return whitened derivative (W, N, 3, 3) of column, row and disparity by the point."""
    z = np.maximum(xyz[:, :, 2], bundle.NEAREST * model.fb / model.focal)
    J = np.zeros((*xyz.shape, 3))
    J[:, :, 0, 0] = J[:, :, 1, 1] = model.focal / z / model.sigma_uv
    J[:, :, 0, 2] = -model.focal * xyz[:, :, 0] / z**2 / model.sigma_uv
    J[:, :, 1, 2] = -model.focal * xyz[:, :, 1] / z**2 / model.sigma_uv
    J[:, :, 2, 2] = -model.fb / z**2 / model.sigma_d
    return J
