"""Bundle adjustment over a short window of frames.

Two frames give a motion; with a few more, each point is seen several times, so that errors of its
disparities average out before they become errors of the path.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import Final

import numpy as np

from recon.core.geometry.se3 import apply, as_transform, invert
from recon.core.least_squares import Problem, minimise
from recon.core.values import RectifiedCamera
from recon.core.values.arrays import Bool, Float64, frozen_array
from recon.odometry.kernels import bundle
from recon.odometry.protocol import OdometryHealth

_ITERATIONS: Final = 6  # Levenberg-Marquardt steps at most
_MIN_GAIN: Final = 1e-3  # relative decrease of the cost below which a step is the last
SIGMA_UV_PX: Final = 0.3  # standard deviation of a tracked column or row, as it is assumed
SIGMA_D_PX: Final = 1.5
"""Standard deviation of a disparity; larger than that of a single match, because its error stays
with a feature from frame to frame and does not average out."""

CAUCHY_SIGMAS: Final = 0.7
"""Residual at which the weight of an observation is one half: most are far smaller than the
standard deviations, which hold for what stays with a feature; those that are not are on something
that moves, or slide along an edge. Chosen on two drives: nearly all their paths are better at 0.7
than at 3, and at 0.5 a rendered road with few features is no longer trusted
(docs/decisions/0018-warped-patches.md)."""

_DOUBTED_SIGMAS: Final = 3.0
"""The same where only the certainty of a pose is asked for: there an observation that fits as
stated counts in full."""

_MAX_SIGMAS: Final = 3.0  # residual above which an observation ends its track


@dataclass(frozen=True, eq=False)
class TrackWindow:
    """W frames and N tracked points."""

    T_world_camera: Float64  # (W, 4, 4), poses, oldest first
    # float64 (W, N, 3), column, row and disparity of each point in each frame; all NaN = not seen,
    # NaN disparity = seen, but not matched
    uvd: Float64
    xyz_world: Float64  # (N, 3), the points

    def __post_init__(self) -> None:
        poses, points = len(self.T_world_camera), len(self.xyz_world)
        for name, shape in (
            ("T_world_camera", (None, 4, 4)),
            ("uvd", (poses, points, 3)),
            ("xyz_world", (points, 3)),
        ):
            frozen_array(f"TrackWindow.{name}", getattr(self, name), np.float64, shape)

    @property
    def seen(self) -> Bool:
        """bool (W, N), where a point was seen."""
        return np.isfinite(self.uvd[:, :, 0])

    def with_frame(self, T_world_camera: Float64, uvd: Float64) -> TrackWindow:
        return replace(
            self,
            T_world_camera=np.concatenate([self.T_world_camera, T_world_camera[None]]),
            uvd=np.concatenate([self.uvd, uvd[None]]),
        )

    def with_points(self, uvd: Float64, xyz_world: Float64) -> TrackWindow:
        """The window with more points, first seen in the newest frame."""
        unseen = np.full((len(self.uvd) - 1, len(uvd), 3), np.nan)
        return replace(
            self,
            uvd=np.concatenate([self.uvd, np.concatenate([unseen, uvd[None]])], axis=1),
            xyz_world=np.concatenate([self.xyz_world, xyz_world]),
        )

    def trimmed(self, frames: int) -> TrackWindow:
        """The newest frames, and the points still tracked or seen twice in them."""
        uvd = self.uvd[-frames:]
        seen = np.isfinite(uvd[:, :, 0])
        keep = seen[-1] | (seen.sum(axis=0) >= 2)
        return TrackWindow(self.T_world_camera[-frames:], uvd[:, keep], self.xyz_world[keep])

    def without_newest(self, wrong: Bool) -> TrackWindow:
        """The window without the newest observations of masked points: their tracks end."""
        uvd = self.uvd.copy()
        uvd[-1, wrong] = np.nan
        return replace(self, uvd=uvd)


def reprojection(window: TrackWindow, camera: RectifiedCamera) -> Float64:
    """Observed minus predicted column, row, disparity (W, N, 3); NaN = unseen."""
    xyz = np.stack([apply(T, window.xyz_world) for T in invert(window.T_world_camera)])
    z = np.maximum(xyz[:, :, 2], bundle.MIN_DEPTH_M)
    f = camera.focal_px
    predicted = np.stack(
        [
            f * xyz[:, :, 0] / z + camera.cx_px,
            f * xyz[:, :, 1] / z + camera.cy_px,
            f * camera.baseline_m / z - camera.doffs_px,
        ],
        axis=-1,
    )
    return np.asarray(window.uvd - predicted)


def weighted(window: TrackWindow, camera: RectifiedCamera) -> tuple[Float64, Float64]:
    """Residuals (W, N, 3) in standard deviations, 0 where unseen, and Cauchy weights (W, N).

    As `adjust` weighs them in its kernel; for the audit of a rig (`recon/rig/audit/`) alone.
    """
    sigmas = np.array([SIGMA_UV_PX, SIGMA_UV_PX, SIGMA_D_PX])
    residual = np.nan_to_num(reprojection(window, camera) / sigmas)
    square = np.square(residual).sum(axis=2)
    return residual, window.seen / (1.0 + square / CAUCHY_SIGMAS**2)


def misfits(window: TrackWindow, camera: RectifiedCamera) -> Bool:
    """Points (N,) whose newest observation is an outlier."""
    residual = np.nan_to_num(reprojection(window, camera)[-1])
    sigmas = [SIGMA_UV_PX, SIGMA_UV_PX, SIGMA_D_PX]
    square = np.square(residual / np.array(sigmas)).sum(axis=1)
    return np.asarray(square > _MAX_SIGMAS**2)


def adjust(window: TrackWindow, camera: RectifiedCamera) -> TrackWindow:
    """Adjust poses and points to all observations; the oldest pose stays fixed.

    Levenberg-Marquardt on whitened residuals with Cauchy weights; the points are eliminated
    (Schur complement), so that each step solves for the poses alone.

    Ref:
        Triggs et al., "Bundle adjustment: a modern synthesis", 1999.
    """
    if len(window.T_world_camera) < 2:
        return window
    usable = window.seen.sum(axis=0) >= 2
    part = TrackWindow(window.T_world_camera, window.uvd[:, usable], window.xyz_world[usable])
    model = _model(camera)
    part = minimise(
        Problem(
            cost=lambda window: _cost(window, model),
            linearise=lambda window: _linearise(window, model),
            step=lambda window, normal, damping: _moved(
                window, *bundle.solve_step(normal, damping)
            ),
        ),
        part,
        rounds=_ITERATIONS,
        damping=1e-4,
        min_gain=_MIN_GAIN,
    )
    xyz_world = window.xyz_world.copy()
    xyz_world[usable] = part.xyz_world
    return TrackWindow(part.T_world_camera, window.uvd, xyz_world)


def pose_information(
    window: TrackWindow, camera: RectifiedCamera, sigma_uv_px: float = SIGMA_UV_PX
) -> Float64:
    """Information (6, 6) of the newest observations on the newest pose.

    Given the frames before; of a step (translation in metres, rotation vector in radians) in the
    axes of the newest frame.
    """
    usable = window.seen[-1] & (window.seen.sum(axis=0) >= 2)
    part = TrackWindow(window.T_world_camera, window.uvd[:, usable], window.xyz_world[usable])
    model = _model(camera)._replace(cauchy=_DOUBTED_SIGMAS, sigma_uv=sigma_uv_px)
    normal = _linearise(part, model)
    inverse = np.linalg.inv(normal.H_point + bundle.RIDGE * np.eye(3))
    cross = normal.H_cross[-1]
    folded = (cross @ inverse) @ cross.transpose(0, 2, 1)
    return np.asarray(normal.H_pose[-1] - folded.sum(axis=0))


def normal_equations(window: TrackWindow, camera: RectifiedCamera) -> bundle.NormalEquations:
    """The normal equations of all poses and points of a window, as `bundle.linearise`.

    For the audit of a rig (`recon/rig/audit/`) alone, which has one more unknown than `adjust`.
    """
    return _linearise(window, _model(camera))


def _linearise(window: TrackWindow, model: bundle.BundleModel) -> bundle.NormalEquations:
    return bundle.linearise(invert(window.T_world_camera), window.uvd, window.xyz_world, model)


def _cost(window: TrackWindow, model: bundle.BundleModel) -> float:
    T_camera_world = invert(window.T_world_camera)
    return float(bundle.cost(T_camera_world, window.uvd, window.xyz_world, tuple(model)))


def _moved(window: TrackWindow, step_pose: Float64, step_point: Float64) -> TrackWindow:
    """A window after a step; poses step by translation and rotation in their own axes."""
    poses = np.stack(
        [T @ as_transform(step) for T, step in zip(window.T_world_camera, step_pose, strict=True)]
    )
    return replace(window, T_world_camera=poses, xyz_world=window.xyz_world + step_point)


def _model(camera: RectifiedCamera) -> bundle.BundleModel:
    return bundle.BundleModel(
        focal=camera.focal_px,
        cx=camera.cx_px,
        cy=camera.cy_px,
        fb=camera.focal_px * camera.baseline_m,
        doffs=camera.doffs_px,
        sigma_uv=SIGMA_UV_PX,
        sigma_d=SIGMA_D_PX,
        cauchy=CAUCHY_SIGMAS,
    )


_INDEPENDENCE: Final = 0.25  # share of the tracks whose errors count as independent
_BEST_PX: Final = 0.05
"""However well features fit, they count as no better: on planes with exact truth they are off by
0.03 px to 0.12 px."""

_MEDIAN: Final = 1.18
"""Median length of an error in the image, in standard deviations along either axis."""


def newest_information(
    window: TrackWindow, camera: RectifiedCamera, sigma_uv_px: float = SIGMA_UV_PX
) -> Float64:
    """Information (6, 6) of the newest pose, scaled because errors of tracks correlate."""
    return _INDEPENDENCE * pose_information(window, camera, sigma_uv_px)


def newest_health(
    window: TrackWindow, camera: RectifiedCamera, tracks: int, note: str = ""
) -> OdometryHealth:
    """The health of the newest pose, to which so many ``tracks`` were followed."""
    newest = window.seen[-1]
    error = reprojection(window, camera)[-1, newest, :2]
    reprojection_px = float(np.median(np.linalg.norm(error, axis=1)))
    # What stays with a feature, its disparity, is as uncertain as assumed however well it fits.
    fits_px = max(reprojection_px, _BEST_PX) / _MEDIAN
    sigma = np.sqrt(np.diag(covariance_of(newest_information(window, camera, fits_px))))
    return OdometryHealth(
        tracks=tracks,
        inliers=int(newest.sum()),
        reprojection_px=reprojection_px,
        sigma_m=float(np.linalg.norm(sigma[:3])),
        sigma_deg=float(np.rad2deg(np.linalg.norm(sigma[3:]))),
        scale_px=_scale_px(window.uvd[-1, :, 2], camera),
        notes=(note,) if note else (),
    )


def _scale_px(disparity: Float64, camera: RectifiedCamera) -> float:
    """The disparity that fixes the length of a motion, from those (N,) of the features.

    A disparity gives a share of the depth, so a feature counts as much as the square of its own.
    """
    d = disparity[np.isfinite(disparity)] + camera.doffs_px
    return float(d @ d / d.sum()) if len(d) else float("nan")


_LEAST_INFORMATION: Final = 1e-4
"""Added along every direction, so that one that nothing fixes gets 100 m or rad, not infinity."""


def covariance_of(information: Float64) -> Float64:
    """The covariance (6, 6) of an information matrix (6, 6), which may be singular."""
    return np.asarray(np.linalg.inv(information + _LEAST_INFORMATION * np.eye(6)))


def step_covariance(sigma_m: float, sigma_deg: float) -> Float64:
    """The covariance (6, 6) of a step that is equally uncertain in all directions."""
    return np.diag(np.repeat([sigma_m**2, np.deg2rad(sigma_deg) ** 2], 3))


def distance_in_sigmas(step: Float64, covariance: Float64) -> float:
    """The length of a step (6,) in standard deviations (Mahalanobis distance)."""
    return float(np.sqrt(step @ np.linalg.solve(covariance, step)))
