"""A short window of frames whose poses and points are adjusted together.

Two frames give a motion; a few more give each point several looks, so that the error of one
disparity is averaged before it becomes an error of the path.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from recon.geometry.se3 import exp_so3, invert, make_transform
from recon.odometry.settings import WindowSettings
from recon.structures import RectifiedCamera
from recon.structures.arrays import Bool, Float64

MIN_DEPTH_M = 0.1


@dataclass(frozen=True, eq=False)
class TrackWindow:
    """W frames and N tracked points.

    Attributes:
        T_world_camera: float64 (W, 4, 4), poses, oldest first.
        uvd: float64 (W, N, 3), column, row and disparity of each point in each frame; all NaN
            = not seen, NaN disparity = seen, but not matched.
        xyz_world: float64 (N, 3), the points.
    """

    T_world_camera: Float64
    uvd: Float64
    xyz_world: Float64

    @property
    def seen(self) -> Bool:
        """bool (W, N), where a point was seen."""
        return np.isfinite(self.uvd[:, :, 0])

    def with_frame(self, T_world_camera: Float64, uvd: Float64) -> TrackWindow:
        """One frame more."""
        return replace(
            self,
            T_world_camera=np.concatenate([self.T_world_camera, T_world_camera[None]]),
            uvd=np.concatenate([self.uvd, uvd[None]]),
        )

    def with_points(self, uvd: Float64, xyz_world: Float64) -> TrackWindow:
        """Points more, first seen in the newest frame."""
        unseen = np.full((len(self.uvd) - 1, len(uvd), 3), np.nan)
        return replace(
            self,
            uvd=np.concatenate([self.uvd, np.concatenate([unseen, uvd[None]])], axis=1),
            xyz_world=np.concatenate([self.xyz_world, xyz_world]),
        )

    def trimmed(self, frames: int) -> TrackWindow:
        """The newest frames, and the points that are still followed or were seen twice in them."""
        uvd = self.uvd[-frames:]
        seen = np.isfinite(uvd[:, :, 0])
        keep = seen[-1] | (seen.sum(axis=0) >= 2)
        return TrackWindow(self.T_world_camera[-frames:], uvd[:, keep], self.xyz_world[keep])

    def without_newest(self, wrong: Bool) -> TrackWindow:
        """Without the newest observations of the points of a mask (N,): their tracks end."""
        uvd = self.uvd.copy()
        uvd[-1, wrong] = np.nan
        return replace(self, uvd=uvd)


def reprojection(window: TrackWindow, camera: RectifiedCamera) -> Float64:
    """Observed minus predicted column, row and disparity (W, N, 3); NaN = not seen."""
    residual, _ = _residuals(window, camera)
    return np.where(np.isfinite(window.uvd), residual, np.nan)


def misfits(window: TrackWindow, camera: RectifiedCamera, settings: WindowSettings) -> Bool:
    """bool (N,), points whose newest observation is too far from its prediction."""
    residual, _ = _residuals(window, camera)
    square = np.square(residual[-1] / _sigmas(settings)).sum(axis=1)
    return np.asarray(square > settings.max_sigmas**2)


def adjust(window: TrackWindow, camera: RectifiedCamera, settings: WindowSettings) -> TrackWindow:
    """Poses and points that explain all observations best; the oldest pose stays.

    Levenberg-Marquardt on whitened residuals with Cauchy weights; the points are eliminated
    (Schur complement), so that each step solves for the poses alone.

    Ref:
        Triggs et al., "Bundle adjustment: a modern synthesis", 1999.
    """
    if len(window.T_world_camera) < 2:
        return window
    usable = window.seen.sum(axis=0) >= 2
    part = TrackWindow(window.T_world_camera, window.uvd[:, usable], window.xyz_world[usable])
    part = _levenberg_marquardt(part, camera, settings)
    xyz_world = window.xyz_world.copy()
    xyz_world[usable] = part.xyz_world
    return TrackWindow(part.T_world_camera, window.uvd, xyz_world)


def _levenberg_marquardt(
    window: TrackWindow, camera: RectifiedCamera, settings: WindowSettings
) -> TrackWindow:
    damping = 1e-4
    cost = _cost(window, camera, settings)
    for _ in range(settings.iterations):
        proposal = _step(window, camera, settings, damping)
        proposed = _cost(proposal, camera, settings)
        if not proposed < cost:
            damping *= 10.0
            continue
        gain = (cost - proposed) / cost
        window, cost, damping = proposal, proposed, 0.1 * damping
        if gain < settings.min_gain:
            break
    return window


def pose_information(
    window: TrackWindow, camera: RectifiedCamera, settings: WindowSettings
) -> Float64:
    """What the newest frame's observations tell about its pose, given the frames before.

    Returns:
        float64 (6, 6), information of a step (translation in metres, rotation vector in radians)
        in the axes of the newest frame.
    """
    usable = window.seen[-1] & (window.seen.sum(axis=0) >= 2)
    part = TrackWindow(window.T_world_camera, window.uvd[:, usable], window.xyz_world[usable])
    normal = _normal_equations(part, camera, settings)
    folded = np.einsum("inj,njk->ink", normal.H_cross[-1], np.linalg.inv(_damped(normal.H_point)))
    return np.asarray(normal.H_pose[-1] - np.einsum("ink,jnk->ij", folded, normal.H_cross[-1]))


@dataclass(frozen=True, eq=False)
class _NormalEquations:
    """Blocks of the Gauss-Newton system: poses (W, 6), points (N, 3), and what ties them."""

    H_pose: Float64
    g_pose: Float64
    H_point: Float64
    g_point: Float64
    H_cross: Float64


def _normal_equations(
    window: TrackWindow, camera: RectifiedCamera, settings: WindowSettings
) -> _NormalEquations:
    residual, xyz_camera = _residuals(window, camera)
    white, weight = _whiten(residual, window.seen, settings)
    J_camera = _projection_jacobian(xyz_camera, camera) / _sigmas(settings)[:, None]
    J_camera *= np.isfinite(window.uvd)[:, :, :, None]
    J_point = J_camera @ invert(window.T_world_camera)[:, None, :3, :3]
    J_pose = _pose_jacobian(J_camera, xyz_camera)
    weighted_pose = J_pose * weight[:, :, None, None]
    weighted_point = J_point * weight[:, :, None, None]
    return _NormalEquations(
        H_pose=np.einsum("wnki,wnkj->wij", weighted_pose, J_pose),
        g_pose=np.einsum("wnki,wnk->wi", weighted_pose, white),
        H_point=np.einsum("wnki,wnkj->nij", weighted_point, J_point),
        g_point=np.einsum("wnki,wnk->ni", weighted_point, white),
        H_cross=np.einsum("wnki,wnkj->winj", weighted_pose, J_point),
    )


def _step(
    window: TrackWindow, camera: RectifiedCamera, settings: WindowSettings, damping: float
) -> TrackWindow:
    """One damped Gauss-Newton step of all poses but the oldest, and of all points."""
    step_pose, step_point = _solve(_normal_equations(window, camera, settings), damping)
    poses = np.stack(
        [_moved(T, step) for T, step in zip(window.T_world_camera, step_pose, strict=True)]
    )
    return replace(window, T_world_camera=poses, xyz_world=window.xyz_world + step_point)


def _solve(normal: _NormalEquations, damping: float) -> tuple[Float64, Float64]:
    """Steps of the poses (W, 6) and of the points (N, 3); the first pose's is zero."""
    free = 6 * (len(normal.H_pose) - 1)
    inverse = np.linalg.inv(_damped(normal.H_point, damping))
    blocks = normal.H_cross[1:].reshape(free, -1, 3)
    folded = np.einsum("anj,njk->ank", blocks, inverse).reshape(free, -1)
    cross = blocks.reshape(free, -1)
    S = _block_diagonal(_damped(normal.H_pose[1:], damping)) - folded @ cross.T
    g = normal.g_pose[1:].reshape(-1) - folded @ normal.g_point.reshape(-1)
    step_pose = np.linalg.solve(S, g)
    rest = normal.g_point - (cross.T @ step_pose).reshape(-1, 3)
    step_point = np.einsum("nij,nj->ni", inverse, rest)
    return np.concatenate([np.zeros((1, 6)), step_pose.reshape(-1, 6)]), step_point


def _damped(H: Float64, damping: float = 0.0) -> Float64:
    """Blocks (N, K, K) with their diagonals raised, so that each can be inverted."""
    diagonal = np.einsum("nii->ni", H)
    raised: Float64 = H.copy()
    np.einsum("nii->ni", raised)[:] += damping * diagonal + 1e-9
    return raised


def _block_diagonal(blocks: Float64) -> Float64:
    count, size, _ = blocks.shape
    full = np.zeros((count, size, count, size))
    full[np.arange(count), :, np.arange(count), :] = blocks
    return full.reshape(count * size, count * size)


def _moved(T_world_camera: Float64, step: Float64) -> Float64:
    """A pose after a step (translation, rotation vector) in its own axes."""
    return np.asarray(T_world_camera @ make_transform(exp_so3(step[3:]), step[:3]))


def _residuals(window: TrackWindow, camera: RectifiedCamera) -> tuple[Float64, Float64]:
    """Observed minus predicted (W, N, 3), zero where not seen, and points in camera axes."""
    T_camera_world = invert(window.T_world_camera)
    xyz = np.einsum("wij,nj->wni", T_camera_world[:, :3, :3], window.xyz_world)
    xyz += T_camera_world[:, None, :3, 3]
    z = np.maximum(xyz[:, :, 2], MIN_DEPTH_M)
    f = camera.focal_px
    predicted = np.stack(
        [
            f * xyz[:, :, 0] / z + camera.cx_px,
            f * xyz[:, :, 1] / z + camera.cy_px,
            f * camera.baseline_m / z - camera.doffs_px,
        ],
        axis=-1,
    )
    return np.where(np.isfinite(window.uvd), window.uvd - predicted, 0.0), xyz


def _projection_jacobian(xyz: Float64, camera: RectifiedCamera) -> Float64:
    """Derivative (W, N, 3, 3) of column, row and disparity by the point in camera axes."""
    z = np.maximum(xyz[:, :, 2], MIN_DEPTH_M)
    f = camera.focal_px
    J = np.zeros((*xyz.shape, 3))
    J[:, :, 0, 0] = J[:, :, 1, 1] = f / z
    J[:, :, 0, 2] = -f * xyz[:, :, 0] / z**2
    J[:, :, 1, 2] = -f * xyz[:, :, 1] / z**2
    J[:, :, 2, 2] = -f * camera.baseline_m / z**2
    return J


def _pose_jacobian(J_point_camera: Float64, xyz_camera: Float64) -> Float64:
    """Derivative (W, N, 3, 6) by a step of the pose in its own axes."""
    return np.concatenate(
        [-J_point_camera, np.cross(J_point_camera, xyz_camera[:, :, None, :])], axis=-1
    )


def _sigmas(settings: WindowSettings) -> Float64:
    return np.array([settings.sigma_uv_px, settings.sigma_uv_px, settings.sigma_d_px])


def _whiten(
    residual: Float64, seen: Bool, settings: WindowSettings
) -> tuple[Float64, NDArray[np.float64]]:
    """Residuals in standard deviations (W, N, 3), and the Cauchy weight of each observation."""
    white = residual / _sigmas(settings)
    square = np.einsum("wnk,wnk->wn", white, white)
    return white, np.where(seen, 1.0 / (1.0 + square / settings.cauchy_sigmas**2), 0.0)


def _cost(window: TrackWindow, camera: RectifiedCamera, settings: WindowSettings) -> float:
    residual, _ = _residuals(window, camera)
    white = residual / _sigmas(settings)
    square = np.einsum("wnk,wnk->wn", white, white)
    return float(np.log1p(square / settings.cauchy_sigmas**2).sum())
