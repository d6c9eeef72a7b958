"""The pose of a frame: found from known points that it sees, then adjusted with the last frames.

Two frames give a motion; with a few more, each point is seen several times, so that errors of its
disparities average out before they become errors of the path (bundle adjustment over a window).
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import Final, NamedTuple

import cv2
import numpy as np

from recon.core.geometry.alignment import Problem, minimise
from recon.core.geometry.se3 import (
    apply,
    as_step,
    as_transform,
    covariance_of,
    invert,
    make_transform,
)
from recon.core.values import RectifiedCamera
from recon.core.values.arrays import Bool, Float64, frozen_array
from recon.core.values.camera import project
from recon.odometry.kernels import bundle
from recon.odometry.protocol import OdometryHealth

REPROJECTION_PX: Final = 2.0  # RANSAC's inlier limit
_SAMPLES: Final = 200  # RANSAC's samples at most
MIN_INLIERS: Final = 15  # fewer agreeing tracks give no pose
_MIN_INLIER_RATIO: Final = 0.3  # a smaller fraction of agreeing tracks gives no pose


def locate_camera(
    xyz_world: Float64, uv: Float64, camera: RectifiedCamera, T_world_guess: Float64
) -> LocatedCamera | None:
    """Locate a camera that sees known points, from the largest set of them that agrees.

    The pose is fitted to that set from the guess and from RANSAC's pose; the fit with more inliers
    wins. None where too few points agree on one.
    """
    how = {"iterations": _SAMPLES, "min_inliers": MIN_INLIERS}
    consensus = find_consensus(xyz_world, uv, camera, limit_px=REPROJECTION_PX, **how)
    if consensus is None:
        return None
    among = consensus.agree
    fits = [
        _agreement(fit_pose(xyz_world[among], uv[among], camera, T), xyz_world, uv, camera)
        for T in (T_world_guess, consensus.T_world_camera)
    ]
    best = max(fits, key=lambda fit: int(fit.agree.sum()))
    return best if enough_agree(int(best.agree.sum()), len(xyz_world)) else None


def enough_agree(agreeing: int, tracks: int) -> bool:
    """Whether so many of the tracks agree that the pose counts as measured."""
    return agreeing >= max(MIN_INLIERS, _MIN_INLIER_RATIO * tracks)


def _agreement(
    T_world_camera: Float64, xyz_world: Float64, uv: Float64, camera: RectifiedCamera
) -> LocatedCamera:
    """Which points agree with a pose; none, where it is not finite."""
    u, v, _ = project(apply(invert(T_world_camera), xyz_world), camera)
    error_px = np.hypot(u - uv[:, 0], v - uv[:, 1])
    # A point behind the camera has a NaN error, which compares as False.
    return LocatedCamera(T_world_camera, np.asarray(error_px <= REPROJECTION_PX))


@dataclass(frozen=True, eq=False)
class LocatedCamera:
    """The pose of a camera, from known points."""

    T_world_camera: Float64  # (4, 4)
    agree: Bool  # (N,), True for the points that agree with it


def find_consensus(
    xyz_world: Float64,
    uv: Float64,
    camera: RectifiedCamera,
    *,
    limit_px: float,
    iterations: int,
    min_inliers: int,
) -> LocatedCamera | None:
    """Find the largest set of points (N, 3), seen at (N, 2), that agree on one pose (RANSAC).

    The pose that comes with it is a closed-form fit (EPnP) that one point near the horizon throws
    off by metres or kilometres: fit it again with `fit_pose`. RANSAC seeds its own generator, so
    equal input gives equal output.

    Ref: Fischler and Bolles, "Random sample consensus", CACM 1981.
    """
    if len(xyz_world) < min_inliers:
        return None
    found, rotation, translation, inliers = cv2.solvePnPRansac(
        xyz_world,
        uv,
        camera.matrix,
        None,
        iterationsCount=iterations,
        reprojectionError=limit_px,
        confidence=0.999,
        flags=cv2.SOLVEPNP_AP3P,
    )
    # Four points give a closed-form pose anyhow; the fit that follows needs more.
    if not found or inliers is None or len(inliers) < min_inliers:
        return None
    agree = np.zeros(len(xyz_world), np.bool_)
    agree[inliers.reshape(-1)] = True
    return LocatedCamera(_pose(rotation, translation), agree)


def fit_pose(
    xyz_world: Float64, uv: Float64, camera: RectifiedCamera, T_world_start: Float64 | None = None
) -> Float64:
    """Fit the pose (4, 4) of least squared reprojection error (Levenberg-Marquardt).

    From an initial pose, or else in closed form from the points.
    """
    if T_world_start is None:
        _, rotation, translation = cv2.solvePnP(
            xyz_world, uv, camera.matrix, None, flags=cv2.SOLVEPNP_SQPNP
        )
    else:
        T_camera_world = invert(T_world_start)
        rotation, _ = cv2.Rodrigues(T_camera_world[:3, :3])
        translation = T_camera_world[:3, 3].reshape(3, 1).copy()
    rotation, translation = cv2.solvePnPRefineLM(
        xyz_world, uv, camera.matrix, None, rotation, translation
    )
    return _pose(rotation, translation)


def _pose(rotation: Float64, translation: Float64) -> Float64:
    """T_world_camera from OpenCV's rotation vector and translation."""
    R, _ = cv2.Rodrigues(rotation)
    return invert(make_transform(R, translation))


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
    z = np.maximum(xyz[:, :, 2], bundle.NEAREST * camera.baseline_m)
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


def misfits(window: TrackWindow, camera: RectifiedCamera) -> Bool:
    """Points (N,) whose newest observation is an outlier."""
    residual = np.nan_to_num(reprojection(window, camera)[-1])
    square = np.square(residual / [SIGMA_UV_PX, SIGMA_UV_PX, SIGMA_D_PX]).sum(axis=1)
    return np.asarray(square > _MAX_SIGMAS**2)


class KnownPose(NamedTuple):
    """What other sensors say of the newest pose of a window."""

    T_world_camera: Float64
    information: Float64  # (6, 6) of a step in its axes


def adjust(
    window: TrackWindow, camera: RectifiedCamera, known: KnownPose | None = None
) -> TrackWindow:
    """Adjust poses and points to all observations; the oldest pose stays fixed.

    Levenberg-Marquardt on whitened residuals with Cauchy weights; the points are eliminated
    (Schur complement), so that each step solves for the poses alone. ``known`` is what other
    sensors say of the newest pose.

    Ref:
        Triggs et al., "Bundle adjustment: a modern synthesis", 1999.
    """
    if len(window.T_world_camera) < 2:
        return window
    usable = window.seen.sum(axis=0) >= 2
    part = TrackWindow(window.T_world_camera, window.uvd[:, usable], window.xyz_world[usable])
    model = model_of(camera)
    part = minimise(
        Problem(
            cost=lambda window: _cost(window, model, known),
            linearise=lambda window: linearise(window, model, known),
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
    model = model_of(camera)._replace(cauchy=_DOUBTED_SIGMAS, sigma_uv=sigma_uv_px)
    normal = linearise(part, model)
    inverse = np.linalg.inv(normal.H_point + bundle.RIDGE * np.eye(3))
    cross = normal.H_cross[-1]
    folded = (cross @ inverse) @ cross.transpose(0, 2, 1)
    return np.asarray(normal.H_pose[-1] - folded.sum(axis=0))


def linearise(
    window: TrackWindow, model: bundle.BundleModel, known: KnownPose | None = None
) -> bundle.NormalEquations:
    """Return the normal equations of all poses and points of a window, as `bundle.linearise`."""
    inverse = invert(window.T_world_camera)
    normal = bundle.linearise(inverse, window.uvd, window.xyz_world, model)
    if known is not None:
        # Tracks count as if their errors were independent.
        weight = known.information / INDEPENDENCE
        normal.H_pose[-1] += weight
        normal.g_pose[-1] += weight @ as_step(inverse[-1] @ known.T_world_camera)
    return normal


def _cost(window: TrackWindow, model: bundle.BundleModel, known: KnownPose | None) -> float:
    T_camera_world = invert(window.T_world_camera)
    cost = float(bundle.cost(T_camera_world, window.uvd, window.xyz_world, tuple(model)))
    if known is None:
        return cost
    off = as_step(T_camera_world[-1] @ known.T_world_camera)
    return cost + float(off @ known.information @ off) / (INDEPENDENCE * model.cauchy**2)


def _moved(window: TrackWindow, step_pose: Float64, step_point: Float64) -> TrackWindow:
    """A window after a step; poses step by translation and rotation in their own axes."""
    poses = window.T_world_camera @ as_transform(step_pose)
    return replace(window, T_world_camera=poses, xyz_world=window.xyz_world + step_point)


def model_of(camera: RectifiedCamera) -> bundle.BundleModel:
    """Return the camera and the weights of observations."""
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


INDEPENDENCE: Final = 0.25  # fraction of the tracks whose errors count as independent
_BEST_PX: Final = 0.05
"""However well features fit, they count as no better: on planes with exact truth they are off by
0.03 px to 0.12 px."""

_MEDIAN: Final = 1.18
"""Median length of an error in the image, in standard deviations along either axis."""


def newest_information(
    window: TrackWindow,
    camera: RectifiedCamera,
    sigma_uv_px: float = SIGMA_UV_PX,
    known: KnownPose | None = None,
) -> Float64:
    """Information (6, 6) of the newest pose, scaled because errors of tracks correlate."""
    seen = INDEPENDENCE * pose_information(window, camera, sigma_uv_px)
    return seen if known is None else seen + known.information


def newest_health(
    window: TrackWindow,
    camera: RectifiedCamera,
    tracks: int,
    note: str = "",
    known: KnownPose | None = None,
) -> OdometryHealth:
    """The health of the newest pose, to which so many ``tracks`` were followed."""
    newest = window.seen[-1]
    error = reprojection(window, camera)[-1, newest, :2]
    reprojection_px = float(np.median(np.linalg.norm(error, axis=1)))
    # What stays with a feature, its disparity, is as uncertain as assumed however well it fits.
    fits_px = max(reprojection_px, _BEST_PX) / _MEDIAN
    information = newest_information(window, camera, fits_px, known)
    sigma = np.sqrt(np.diag(covariance_of(information)))
    disparity = window.uvd[-1, :, 2]
    d = disparity[np.isfinite(disparity)] + camera.doffs_px
    return OdometryHealth(
        tracks=tracks,
        inliers=int(newest.sum()),
        reprojection_px=reprojection_px,
        sigma_m=float(np.linalg.norm(sigma[:3])),
        sigma_deg=float(np.rad2deg(np.linalg.norm(sigma[3:]))),
        # A disparity gives a fraction of the depth: a feature counts by the square of its own.
        scale_px=float(d @ d / d.sum()) if len(d) else float("nan"),
        notes=(note,) if note else (),
    )
