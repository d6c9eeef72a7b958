"""Visual odometry: features followed through a short window of stereo frames."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from recon.geometry.projection import project, unproject
from recon.geometry.se3 import apply, invert
from recon.geometry.triangulation import depth_from_disparity
from recon.odometry.corners import find_corners
from recon.odometry.pose import enough_agree, locate_camera
from recon.odometry.protocol import OdometryFrame, OdometryHealth, OdometryResult
from recon.odometry.settings import VisualSettings
from recon.odometry.tracking import follow, sample_disparity
from recon.odometry.window import TrackWindow, adjust, misfits, pose_information, reprojection
from recon.structures import RectifiedCamera
from recon.structures.arrays import Float32, Float64, UInt8


@dataclass(frozen=True, eq=False)
class VisualState:
    """What is kept from frame to frame.

    Attributes:
        window: The last frames and the points seen in them.
        left: uint8 (H, W), the last left picture.
        motion: float64 (4, 4), the last motion, ``T_previous_camera``.
    """

    window: TrackWindow
    left: UInt8
    motion: Float64


@dataclass(frozen=True, eq=False)
class VisualEstimate:
    """A pose, and how well it is known.

    Attributes:
        result: Pose and health.
        information: float64 (6, 6) of a step (translation in metres, rotation vector in
            radians) in camera axes; None where the pose is extrapolated.
    """

    result: OdometryResult
    information: Float64 | None


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
        return self.track(frame).result

    def track(self, frame: OdometryFrame) -> VisualEstimate:
        """The same, with what is known about the pose."""
        if self._state is None:
            window, motion = _empty(np.eye(4)), np.eye(4)
            health, information = OdometryHealth(), None
        else:
            window, health, information = self._advance(self._state, frame)
            motion = invert(self._state.window.T_world_camera[-1]) @ window.T_world_camera[-1]
        T_world_camera = window.T_world_camera[-1].copy()
        window = self._replenish(window.trimmed(self._settings.window.frames), frame)
        self._state = VisualState(window, frame.pair.left, motion)
        return VisualEstimate(OdometryResult(T_world_camera, health), information)

    def _advance(
        self, state: VisualState, frame: OdometryFrame
    ) -> tuple[TrackWindow, OdometryHealth, Float64 | None]:
        """The window with the new frame in it, or a new one where the old is lost."""
        predicted = state.window.T_world_camera[-1] @ state.motion
        camera, settings = frame.pair.camera, self._settings
        uvd = self._observe(state, frame, predicted)
        tracks = np.flatnonzero(np.isfinite(uvd[:, 0]))
        found = locate_camera(
            state.window.xyz_world[tracks], uvd[tracks, :2], camera, predicted, settings.pose
        )
        if found is None:
            return _lost(predicted, len(tracks))
        uvd[tracks[~found.agree]] = np.nan
        window = adjust(state.window.with_frame(found.T_world_camera, uvd), camera, settings.window)
        window = window.without_newest(misfits(window, camera, settings.window))
        if not enough_agree(int(window.seen[-1].sum()), len(tracks), settings.pose):
            return _lost(predicted, len(tracks))
        health = _health(window, len(tracks), camera)
        return window, health, pose_information(window, camera, settings.window)

    def _observe(self, state: VisualState, frame: OdometryFrame, predicted: Float64) -> Float64:
        """Column, row and disparity (N, 3) in the new frame of the points of the window."""
        window = state.window
        uvd = np.full((len(window.xyz_world), 3), np.nan)
        alive = np.flatnonzero(window.seen[-1])
        uv = window.uvd[-1, alive, :2].astype(np.float32)
        u, v, _ = project(apply(invert(predicted), window.xyz_world[alive]), frame.pair.camera)
        guess = np.stack([u, v], axis=1)
        guess = np.where(np.isfinite(guess), guess, uv).astype(np.float32)
        there, found = follow(state.left, frame.pair.left, uv, guess, self._settings.tracks)
        uvd[alive[found], :2] = there[found]
        uvd[alive[found], 2] = self._disparity(frame, there[found])
        return uvd

    def _disparity(self, frame: OdometryFrame, uv: Float32) -> Float64:
        """Disparity (N,) of features; NaN = unknown, or too small to tell a depth."""
        d = sample_disparity(frame.disparity, uv, self._settings.tracks).astype(np.float64)
        far = d + frame.pair.camera.doffs_px < self._settings.pose.min_disparity_px
        return np.where(far, np.nan, d)

    def _replenish(self, window: TrackWindow, frame: OdometryFrame) -> TrackWindow:
        """The window with new points where the newest frame has room for them."""
        taken = window.uvd[-1, window.seen[-1], :2].astype(np.float32)
        uv = find_corners(frame.pair.left, taken, self._settings.corners)
        d = self._disparity(frame, uv)
        uvd = np.column_stack([uv, d])[np.isfinite(d)]
        depth = depth_from_disparity(uvd[:, 2], frame.pair.camera).astype(np.float64)
        xyz_camera = unproject(uvd[:, 0], uvd[:, 1], depth, frame.pair.camera)
        return window.with_points(uvd, apply(window.T_world_camera[-1], xyz_camera))


def _lost(predicted: Float64, tracks: int) -> tuple[TrackWindow, OdometryHealth, None]:
    """A new window where the last motion would have led."""
    note = f"lost: {tracks} tracks, too few agree on a motion; the last one goes on"
    return _empty(predicted), OdometryHealth(False, tracks, notes=(note,)), None


def _empty(T_world_camera: Float64) -> TrackWindow:
    """A window of one frame without points."""
    return TrackWindow(T_world_camera[None], np.zeros((1, 0, 3)), np.zeros((0, 3)))


def _health(window: TrackWindow, tracks: int, camera: RectifiedCamera) -> OdometryHealth:
    newest = window.seen[-1]
    error = reprojection(window, camera)[newest, :2]
    return OdometryHealth(
        tracks=tracks,
        inliers=int(newest.sum()),
        reprojection_px=float(np.median(np.linalg.norm(error, axis=1))),
    )
