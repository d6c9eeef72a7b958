"""The motion between two stereo frames from points that both see, symmetric in the two."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Final

import numpy as np
from numpy.typing import NDArray

from recon.core.geometry.se3 import apply, as_transform, invert, step_jacobian
from recon.core.values import RectifiedCamera
from recon.core.values.arrays import Bool, Float64
from recon.core.values.camera import project
from recon.odometry.pose import find_consensus, fit_pose

_ITERATIONS: Final = 500  # RANSAC's samples at most
_LIMIT_PX: Final = 2.5  # RANSAC's inlier limit
MIN_INLIERS: Final = 20  # least number of matches that agree in both directions
_SIGMA_UV_PX: Final = 1.0  # standard deviation of a feature's column or row
_SIGMA_D_PX: Final = 1.0  # standard deviation of its disparity
_STEPS: Final = 15
_CAUCHY_SIGMAS: Final = 2.0
_SHARED: Final = 0.5  # both directions see the same matches, so together they count once


@dataclass(frozen=True, eq=False)
class Seen:
    """Matched points as one frame sees them."""

    uvd: Float64  # (N, 3), column, row, disparity
    xyz: Float64  # (N, 3), the same points in camera axes
    camera: RectifiedCamera  # that of the frame

    def select(self, rows: NDArray[np.bool_]) -> Seen:
        """Return some of the points."""
        return Seen(self.uvd[rows], self.xyz[rows], self.camera)


@dataclass(frozen=True, eq=False)
class Alignment:
    """A motion between two frames."""

    T_first_last: Float64  # (4, 4)
    agree: Bool  # (N,), matches that agree with it in both views
    # float64 (6, 6) of a step (translation in metres, rotation vector in radians) in the axes of
    # the last frame
    information: Float64


def locate(points: Float64, seen: Seen) -> Float64 | None:
    """Return the pose of a camera that sees known points, ``T_points_camera``; None = no pose."""
    uv, camera = seen.uvd[:, :2], seen.camera
    consensus = find_consensus(
        points, uv, camera, limit_px=_LIMIT_PX, iterations=_ITERATIONS, min_inliers=MIN_INLIERS
    )
    if consensus is None:
        return None
    T = fit_pose(points[consensus.agree], uv[consensus.agree], camera)
    return T if np.isfinite(T).all() else None


def refine(first: Seen, last: Seen, T_first_last: Float64) -> Alignment:
    """Fit the motion to columns, rows and disparities in both frames, with Cauchy weights."""
    T = T_first_last
    for _ in range(_STEPS):
        H, g = _normal_equations(first, last, T)
        step = np.linalg.solve(H + 1e-9 * np.eye(6), -g)
        T = T @ as_transform(step)
        if np.linalg.norm(step) < 1e-6:
            break
    H, _ = _normal_equations(first, last, T)
    return Alignment(T, agreement(first, last, T), _SHARED * H)


def agreement(first: Seen, last: Seen, T_first_last: Float64) -> Bool:
    """Return bool (N,), matches whose reprojection error is within the limit in both frames."""
    agree = np.ones(len(first.xyz), np.bool_)
    both = (T_first_last, last.xyz, first), (invert(T_first_last), first.xyz, last)
    for T, points, seen in both:
        u, v, _ = project(apply(T, points), seen.camera)
        # A point behind the camera has a NaN error, which compares as False.
        agree &= np.hypot(u - seen.uvd[:, 0], v - seen.uvd[:, 1]) <= _LIMIT_PX
    return agree


def _normal_equations(first: Seen, last: Seen, T: Float64) -> tuple[Float64, Float64]:
    """Return Gauss-Newton's matrix (6, 6) and gradient (6,) for a step in the axes of ``last``."""
    H, g = np.zeros((6, 6)), np.zeros(6)
    # Points of the last frame, seen by the first: they move with the step.
    moved = apply(T, last.xyz)
    turn = T[:3, :3] @ step_jacobian(last.xyz)
    # Points of the first frame, seen by the last: they move against it.
    back = apply(invert(T), first.xyz)
    for xyz, d_xyz, seen in ((moved, turn, first), (back, -step_jacobian(back), last)):
        r, J = _residuals(xyz, d_xyz, seen)
        weight = 1.0 / (1.0 + np.einsum("nk,nk->n", r, r) / _CAUCHY_SIGMAS**2)
        H += np.einsum("nki,n,nkj->ij", J, weight, J)
        g += np.einsum("nki,n,nk->i", J, weight, r)
    return H, g


def _residuals(xyz: Float64, d_xyz: Float64, seen: Seen) -> tuple[Float64, Float64]:
    """Return whitened residuals (N, 3) and derivatives (N, 3, 6); 0 for points behind a camera."""
    sigma, camera = np.array([_SIGMA_UV_PX, _SIGMA_UV_PX, _SIGMA_D_PX]), seen.camera
    front = xyz[:, 2] > 0.1
    z = np.where(front, xyz[:, 2], 1.0)
    f, b = camera.focal_px, camera.baseline_m
    u, v = f * xyz[:, 0] / z + camera.cx_px, f * xyz[:, 1] / z + camera.cy_px
    predicted = np.stack([u, v, f * b / z - camera.doffs_px], axis=1)
    J = np.zeros((len(xyz), 3, 3))
    J[:, 0, 0] = J[:, 1, 1] = f / z
    J[:, 0, 2], J[:, 1, 2] = -f * xyz[:, 0] / z**2, -f * xyz[:, 1] / z**2
    J[:, 2, 2] = -f * b / z**2
    J = np.where(front[:, None, None], J @ d_xyz / sigma[:, None], 0.0)
    return np.where(front[:, None], (predicted - seen.uvd) / sigma, 0.0), J
