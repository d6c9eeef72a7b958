"""Visual odometry: features followed through a short window of stereo frames."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np

from recon.geometry.projection import project, unproject
from recon.geometry.se3 import apply, invert
from recon.odometry.corners import find_corners
from recon.odometry.pose import locate_camera
from recon.odometry.protocol import OdometryFrame, OdometryHealth, OdometryResult
from recon.odometry.settings import VisualSettings
from recon.odometry.tracking import (
    follow,
    sample_disparity,
)
from recon.odometry.window import TrackWindow, adjust, reprojection
from recon.structures import RectifiedCamera
from recon.structures.arrays import Bool, Float32, Float64, UInt8


@dataclass(frozen=True, eq=False)
class VisualState:
    """What is kept from frame to frame.

    Attributes:
        window: The last frames and the points seen in them.
        left: The last left picture.
        motion: float64 (4, 4), last motion, ``T_previous_camera``.
    """

    window: TrackWindow
    left: UInt8
    motion: Float64


class VisualOdometry:
    """Follows the camera by the features it sees.

    Args:
        settings: Corners, tracks, pose and window.
    """

    def __init__(self, settings: VisualSettings) -> None:
        self._settings = settings
        self._state: VisualState | None = None

    def register(self, frame: OdometryFrame) -> OdometryResult:
        """Register the next frame; without a visual motion, the last one is assumed to go on."""
        left, right = frame.pair.left, frame.pair.right
        if self._state is None:
            window, health = self._empty(np.eye(4)), OdometryHealth(notes=("first frame",))
            motion = np.eye(4)
        else:
            window, health = self._advance(self._state, frame, left, right)
            motion = invert(self._state.window.T_world_camera[-1]) @ window.T_world_camera[-1]
        window = self._replenish(window.trimmed(self._settings.window.frames), frame, left, right)
        self._state = VisualState(window, left, motion)
        return OdometryResult(window.T_world_camera[-1].copy(), health)

    def _empty(self, T_world_camera: Float64) -> TrackWindow:
        return TrackWindow(T_world_camera[None], np.zeros((1, 0, 3)), np.zeros((0, 3)))

    def _advance(
        self, state: VisualState, frame: OdometryFrame, left: UInt8, right: UInt8
    ) -> tuple[TrackWindow, OdometryHealth]:
        predicted = state.window.T_world_camera[-1] @ state.motion
        uvd = self._observe(state, frame, predicted)
        seen = np.isfinite(uvd[:, 0])
        found = locate_camera(
            state.window.xyz_world[seen], uvd[seen, :2], frame.pair.camera, self._settings.pose
        )
        tracks = int(seen.sum())
        if found is None:
            health = OdometryHealth(ok=False, tracks=tracks, notes=("lost",))
            return self._empty(predicted), health
        T_world_camera, agree = found
        uvd[np.flatnonzero(seen)[~agree]] = np.nan
        window = state.window.with_frame(T_world_camera, uvd)
        window = self._refine(window, frame.pair.camera)
        return window, self._health(window, tracks, frame.pair.camera)

    def _observe(self, state: VisualState, frame: OdometryFrame, predicted: Float64) -> Float64:
        """Column, row and disparity (N, 3) in the new frame of the points of the window."""
        window, settings = state.window, self._settings
        uvd = np.full((window.uvd.shape[1], 3), np.nan)
        alive = np.flatnonzero(window.seen[-1])
        uv = window.uvd[-1, alive, :2].astype(np.float32)
        u, v, _ = project(apply(invert(predicted), window.xyz_world[alive]), frame.pair.camera)
        guess = np.stack([u, v], axis=1)
        guess = np.where(np.isfinite(guess), guess, uv).astype(np.float32)
        there, found = follow(state.left, frame.pair.left, uv, guess, settings.tracks)
        uvd[alive[found], :2] = there[found]
        uvd[alive[found], 2] = self._disparity(frame, there[found])
        return uvd

    def _disparity(self, frame: OdometryFrame, uv: Float32) -> Float64:
        """Disparity (N,) of features; NaN = unknown, or too small to tell a depth."""
        d = sample_disparity(frame.disparity, uv, self._settings.tracks).astype(np.float64)
        far = d + frame.pair.camera.doffs_px < self._settings.pose.min_disparity_px
        return np.where(far, np.nan, d)

    def _refine(self, window: TrackWindow, camera: RectifiedCamera) -> TrackWindow:
        settings = self._settings.window
        window = adjust(window, camera, settings)
        sigmas = np.array([settings.sigma_uv_px, settings.sigma_uv_px, settings.sigma_d_px])
        with np.errstate(invalid="ignore"):
            wrong = np.nansum((reprojection(window, camera) / sigmas)**2, axis=2) > settings.max_sigmas**2
        wrong[:-1] = False
        return window.without(wrong)

    def _health(self, window, tracks, camera):
        error = reprojection(window, camera)[-1, :, :2]
        error = np.linalg.norm(error[np.isfinite(error[:, 0])], axis=1)
        return OdometryHealth(tracks=tracks, inliers=len(error), reprojection_px=float(np.median(error)))

    def _replenish(self, window, frame, left, right):
        taken = window.uvd[-1, window.seen[-1], :2].astype(np.float32)
        uv = find_corners(frame.pair.left, taken, self._settings.corners)
        d = self._disparity(frame, uv)
        good = np.isfinite(d)
        uv, d = uv[good].astype(float), d[good].astype(float)
        cam = frame.pair.camera
        z = cam.focal_px * cam.baseline_m / (d + cam.doffs_px)
        xyz = unproject(uv[:, 0], uv[:, 1], z, cam)
        return window.with_points(np.column_stack([uv, d]), apply(window.T_world_camera[-1], xyz))
