"""`recon.odometry.kernels.bundle` in plain numpy: the definition of its results."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from recon.odometry.kernels.bundle import MIN_DEPTH_M, RIDGE, BundleModel, NormalEquations

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
    weighted_pose = J_pose * weight[:, :, None, None]
    weighted_point = J_point * weight[:, :, None, None]
    return NormalEquations(
        H_pose=np.einsum("wnki,wnkj->wij", weighted_pose, J_pose),
        g_pose=np.einsum("wnki,wnk->wi", weighted_pose, white),
        H_point=np.einsum("wnki,wnkj->nij", weighted_point, J_point),
        g_point=np.einsum("wnki,wnk->ni", weighted_point, white),
        H_cross=np.einsum("wnki,wnkj->wnij", weighted_pose, J_point),
    )


def solve_step_reference(normal: NormalEquations, damping: float) -> tuple[Float64, Float64]:
    """Return the reference of `bundle.solve_step`: the whole system, not reduced."""
    H, g = whole_system(normal, damping)
    step = np.zeros(len(g))
    step[6:] = np.linalg.solve(H[6:, 6:], g[6:])
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
    predicted = np.stack(
        [
            model.focal * xyz[:, :, 0] / z + model.cx,
            model.focal * xyz[:, :, 1] / z + model.cy,
            model.fb / z - model.doffs,
        ],
        axis=-1,
    )
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
