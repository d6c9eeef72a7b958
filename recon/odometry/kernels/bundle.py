"""Bundle adjustment: a Gauss-Newton step of the poses of a few frames and the points seen in them.

The system is sparse, because a point connects only the frames that see it. So the points are
eliminated one by one (Schur complement), which leaves a small system of the poses alone.

The reference implementations in plain numpy are in `tests/odometry/kernels/test_bundle.py`.
"""

from __future__ import annotations

import math
from typing import Final, NamedTuple

import numpy as np
from numpy.typing import NDArray

from recon.core.kernels.compiled import kernel

Float64 = NDArray[np.float64]

NEAREST: Final = 0.2  # of the baseline: what is nearer is not in both views
RIDGE: Final = 1e-9
"""Added to the diagonals, so that the system is solvable where nothing is observed."""


class BundleModel(NamedTuple):
    """How a point is seen, and how much its observations count."""

    focal: float  # focal length, pixels
    cx: float  # column of the principal point
    cy: float  # row of the principal point
    fb: float  # focal length times baseline
    doffs: float  # difference of the principal points, pixels
    sigma_uv: float  # standard deviation of a column and a row
    sigma_d: float  # standard deviation of a disparity
    cauchy: float  # residual in standard deviations at which an observation counts half


class NormalEquations(NamedTuple):
    """Blocks of the Gauss-Newton system: poses (W, 6), points (N, 3), and between the two.

    A step of a pose is a translation and a rotation vector in its own axes.
    """

    H_pose: Float64
    g_pose: Float64
    H_point: Float64
    g_point: Float64
    H_cross: Float64


def linearise(
    T_camera_world: Float64, uvd: Float64, xyz_world: Float64, model: BundleModel
) -> NormalEquations:
    """Return the normal equations of all observations, with Cauchy weights.

    Args:
        T_camera_world: float64 (W, 4, 4).
        uvd: float64 (W, N, 3), column, row, disparity; all NaN = not seen, NaN disparity = seen,
            but not matched.
        xyz_world: float64 (N, 3).
        model: Camera and weights.

    Returns:
        ``H_pose`` (W, 6, 6), ``g_pose`` (W, 6), ``H_point`` (N, 3, 3), ``g_point`` (N, 3) and
        ``H_cross`` (W, N, 6, 3).
    """
    frames, points = len(uvd), len(xyz_world)
    normal = NormalEquations(
        np.zeros((frames, 6, 6)),
        np.zeros((frames, 6)),
        np.zeros((points, 3, 3)),
        np.zeros((points, 3)),
        np.zeros((frames, points, 6, 3)),
    )
    # Plain tuples: numba's cache on disk would remember the classes by name.
    _linearise(T_camera_world, uvd, xyz_world, tuple(model), tuple(normal))
    return normal


def solve_step(normal: NormalEquations, damping: float) -> tuple[Float64, Float64]:
    """Damped steps of the poses (W, 6), the first of which stays, and of the points (N, 3)."""
    step_pose = np.zeros((len(normal.H_pose), 6))
    step_point = np.zeros((len(normal.H_point), 3))
    _solve(tuple(normal), damping, step_pose, step_point)
    return step_pose, step_point


@kernel
def cost(
    T_camera_world: Float64, uvd: Float64, xyz_world: Float64, model: tuple[float, ...]
) -> float:
    """Sum of the Cauchy costs of all observations; arguments as those of `linearise`."""
    residual, total = np.empty(3), 0.0
    place = np.empty(3)
    for w in range(uvd.shape[0]):
        for n in range(uvd.shape[1]):
            if np.isfinite(uvd[w, n, 0]):
                _observe(T_camera_world[w], xyz_world[n], uvd[w, n], model, place, residual)
                total += math.log1p(_square(residual) / (model[7] * model[7]))
    return total


@kernel
def _observe(
    T: Float64,
    xyz: Float64,
    uvd: Float64,
    model: tuple[float, ...],
    place: Float64,
    residual: Float64,
) -> None:
    """Place of a point in camera axes, and its residuals in standard deviations; NaN counts 0."""
    focal, cx, cy, fb, doffs, sigma_uv, sigma_d, _ = model
    for i in range(3):
        place[i] = T[i, 0] * xyz[0] + T[i, 1] * xyz[1] + T[i, 2] * xyz[2] + T[i, 3]
    z = max(place[2], NEAREST * fb / focal)
    residual[0] = (uvd[0] - (focal * place[0] / z + cx)) / sigma_uv
    residual[1] = (uvd[1] - (focal * place[1] / z + cy)) / sigma_uv
    residual[2] = (uvd[2] - (fb / z - doffs)) / sigma_d
    if not np.isfinite(uvd[2]):
        residual[2] = 0.0


@kernel
def _square(vector: Float64) -> float:
    return float(vector[0] * vector[0] + vector[1] * vector[1] + vector[2] * vector[2])


@kernel
def _linearise(
    T_camera_world: Float64,
    uvd: Float64,
    xyz_world: Float64,
    model: tuple[float, ...],
    normal: tuple[Float64, ...],
) -> None:
    H_pose, g_pose, H_point, g_point, H_cross = normal
    focal, _, _, fb, _, sigma_uv, sigma_d, cauchy = model
    place, residual = np.empty(3), np.empty(3)
    camera, by_point, by_pose = np.zeros(3), np.empty(3), np.empty(6)
    for w in range(uvd.shape[0]):
        T = T_camera_world[w]
        for n in range(uvd.shape[1]):
            if not np.isfinite(uvd[w, n, 0]):
                continue
            _observe(T, xyz_world[n], uvd[w, n], model, place, residual)
            weight = 1.0 / (1.0 + _square(residual) / (cauchy * cauchy))
            x, y, z = place[0], place[1], max(place[2], NEAREST * fb / focal)
            for k in range(3):
                if k == 2 and not np.isfinite(uvd[w, n, 2]):
                    continue
                # Derivative of column, row or disparity by the point in camera axes.
                camera[0] = focal / z / sigma_uv if k == 0 else 0.0
                camera[1] = focal / z / sigma_uv if k == 1 else 0.0
                if k == 2:
                    camera[2] = -fb / (z * z) / sigma_d
                else:
                    camera[2] = -focal * (x if k == 0 else y) / (z * z) / sigma_uv
                for i in range(3):
                    by_point[i] = camera[0] * T[0, i] + camera[1] * T[1, i] + camera[2] * T[2, i]
                    by_pose[i] = -camera[i]
                by_pose[3] = camera[1] * place[2] - camera[2] * place[1]
                by_pose[4] = camera[2] * place[0] - camera[0] * place[2]
                by_pose[5] = camera[0] * place[1] - camera[1] * place[0]
                for i in range(6):
                    scaled = weight * by_pose[i]
                    g_pose[w, i] += scaled * residual[k]
                    for j in range(6):
                        H_pose[w, i, j] += scaled * by_pose[j]
                    for j in range(3):
                        H_cross[w, n, i, j] += scaled * by_point[j]
                for i in range(3):
                    scaled = weight * by_point[i]
                    g_point[n, i] += scaled * residual[k]
                    for j in range(3):
                        H_point[n, i, j] += scaled * by_point[j]


@kernel
def _solve(
    normal: tuple[Float64, ...], damping: float, step_pose: Float64, step_point: Float64
) -> None:
    """Schur complement: the system of the poses, then the points one by one."""
    H_pose, g_pose, H_point, g_point, H_cross = normal
    frames, points = len(H_pose), len(H_point)
    size = 6 * (frames - 1)
    S, g = np.zeros((size, size)), np.empty(size)
    for w in range(1, frames):
        at = 6 * (w - 1)
        for i in range(6):
            g[at + i] = g_pose[w, i]
            for j in range(6):
                S[at + i, at + j] = H_pose[w, i, j]
            S[at + i, at + i] += damping * H_pose[w, i, i] + RIDGE
    inverses = np.empty((points, 3, 3))
    seen, folded = np.empty(frames, np.int64), np.empty((6, 3))
    for n in range(points):
        _invert(H_point[n], damping, inverses[n])
        count = 0
        for w in range(1, frames):
            if np.any(H_cross[w, n]):
                seen[count] = w
                count += 1
        for a in range(count):
            _multiply(H_cross[seen[a], n], inverses[n], folded)
            row = 6 * (seen[a] - 1)
            for i in range(6):
                for c in range(3):
                    g[row + i] -= folded[i, c] * g_point[n, c]
            for b in range(a + 1):
                _subtract(S, row, 6 * (seen[b] - 1), folded, H_cross[seen[b], n])
    _solve_symmetric(S, g)
    rest = np.empty(3)
    for n in range(points):
        for c in range(3):
            rest[c] = g_point[n, c]
            for w in range(1, frames):
                for i in range(6):
                    rest[c] -= H_cross[w, n, i, c] * g[6 * (w - 1) + i]
        for i in range(3):
            inverse = inverses[n, i]
            step_point[n, i] = inverse[0] * rest[0] + inverse[1] * rest[1] + inverse[2] * rest[2]
    for w in range(1, frames):
        step_pose[w] = g[6 * (w - 1) : 6 * w]


@kernel
def _invert(H: Float64, damping: float, inverse: Float64) -> None:
    """Inverse of a symmetric 3x3 block with a raised diagonal, by cofactors."""
    raised = 1.0 + damping
    a, b, c = H[0, 0] * raised + RIDGE, H[1, 1] * raised + RIDGE, H[2, 2] * raised + RIDGE
    d, e, f = H[0, 1], H[0, 2], H[1, 2]
    inverse[0, 0] = b * c - f * f
    inverse[1, 1] = a * c - e * e
    inverse[2, 2] = a * b - d * d
    inverse[0, 1] = inverse[1, 0] = e * f - d * c
    inverse[0, 2] = inverse[2, 0] = d * f - e * b
    inverse[1, 2] = inverse[2, 1] = d * e - a * f
    determinant = a * inverse[0, 0] + d * inverse[0, 1] + e * inverse[0, 2]
    for i in range(3):
        for j in range(3):
            inverse[i, j] /= determinant


@kernel
def _multiply(block: Float64, inverse: Float64, folded: Float64) -> None:
    for i in range(6):
        for j in range(3):
            total = block[i, 0] * inverse[0, j] + block[i, 1] * inverse[1, j]
            folded[i, j] = total + block[i, 2] * inverse[2, j]


@kernel
def _subtract(S: Float64, row: int, column: int, folded: Float64, block: Float64) -> None:
    for i in range(6):
        for j in range(6):
            total = folded[i, 0] * block[j, 0] + folded[i, 1] * block[j, 1]
            S[row + i, column + j] -= total + folded[i, 2] * block[j, 2]


@kernel
def _solve_symmetric(S: Float64, g: Float64) -> None:
    """Solve ``S x = g`` in place from the lower half of S, as L·D·Lᵀ.

    Where a pivot is not positive the system is not positive definite, and no step is made.
    """
    size = len(g)
    for j in range(size):
        for k in range(j):
            S[j, j] -= S[j, k] * S[j, k] * S[k, k]
        if not S[j, j] > 0.0:
            g[:] = 0.0
            return
        for i in range(j + 1, size):
            for k in range(j):
                S[i, j] -= S[i, k] * S[j, k] * S[k, k]
            S[i, j] /= S[j, j]
    for i in range(size):
        for k in range(i):
            g[i] -= S[i, k] * g[k]
    for i in range(size):
        g[i] /= S[i, i]
    for i in range(size - 1, -1, -1):
        for k in range(i + 1, size):
            g[i] -= S[k, i] * g[k]
