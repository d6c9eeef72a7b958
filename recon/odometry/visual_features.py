"""Features of visual odometry: where the points of a window are in a frame, and new points."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Final

import numpy as np

from recon.core.geometry.projection import depth_from_disparity, project, unproject
from recon.core.geometry.se3 import apply, invert
from recon.core.values import Disparity, RectifiedCamera
from recon.core.values.arrays import Float32, Float64, UInt8
from recon.odometry.corners import find_corners, find_fewer_corners, in_crowd
from recon.odometry.locate_camera import REPROJECTION_PX
from recon.odometry.motion import Motion
from recon.odometry.patches import find_again, measure_disparity, surface_slopes, warp_of
from recon.odometry.protocol import OdometryFrame
from recon.odometry.tracking import follow, sample_disparity
from recon.odometry.window import TrackWindow

MIN_DISPARITY_PX: Final = 0.5
"""Features with less disparity count as without depth."""


@dataclass(frozen=True, eq=False)
class VisualState:
    """What is kept from frame to frame.

    Attributes:
        window: The last frames that were registered, and the points in them.
        left: uint8 (H, W), the left image of the newest of them.
        disparity: Its disparity.
        motion: Pose and motion by now, which may be some frames later.
        seen_s: Time of the newest frame that was registered.
    """

    window: TrackWindow
    left: UInt8
    disparity: Disparity
    motion: Motion
    seen_s: float


def follow_points(state: VisualState, frame: OdometryFrame, predicted: Float64) -> Float64:
    """Return column and row (N, 2) in the new frame of the points of the window, tracked."""
    window = state.window
    there = np.full((len(window.xyz_world), 2), np.nan)
    alive = np.flatnonzero(window.seen[-1])
    uv = window.uvd[-1, alive, :2].astype(np.float32)
    expected = _seen_from(predicted, window.xyz_world[alive], frame.pair.camera)
    guess = np.where(np.isfinite(expected), expected, uv).astype(np.float32)
    followed, found = follow(state.left, frame.pair.left, uv, guess)
    there[alive[found]] = followed[found]
    return there


def observe_points(
    state: VisualState, frame: OdometryFrame, followed: Float64, T_world_camera: Float64
) -> Float64:
    """Return column, row and disparity (N, 3) in a frame of known pose of the window's points.

    Args:
        state: The frames before.
        frame: The frame.
        followed: float64 (N, 2), where tracking has found the points; NaN = nowhere.
        T_world_camera: float64 (4, 4), about its pose.
    """
    window, camera = state.window, frame.pair.camera
    uvd = np.full((len(window.xyz_world), 3), np.nan)
    alive = np.flatnonzero(window.seen[-1])
    uv, xyz_world = window.uvd[-1, alive, :2], window.xyz_world[alive]
    T_then_world = invert(window.T_world_camera[-1])
    T_now_then = invert(T_world_camera) @ window.T_world_camera[-1]
    slope = surface_slopes(state.disparity, uv)
    warp = warp_of(uv, apply(T_then_world, xyz_world), slope, T_now_then, camera)
    expected = _seen_from(T_world_camera, xyz_world, camera)
    with np.errstate(invalid="ignore"):
        near = np.abs(followed[alive] - expected).max(axis=1) <= REPROJECTION_PX
    guess = np.where(near[:, None], followed[alive], expected)
    uvd[alive, :2] = find_again(state.left, frame.pair.left, uv, warp, guess)
    there = alive[np.isfinite(uvd[alive, 0])]
    uv_now = uvd[there, :2].astype(np.float32)
    uvd[there, 2] = feature_disparity(frame, uv_now)
    return uvd


def feature_disparity(frame: OdometryFrame, uv: Float32) -> Float64:
    """Return the disparity (N,) of features of a frame, measured anew where the frame is rough.

    NaN as in `known_disparity`.
    """
    d = known_disparity(frame.disparity, frame.pair.camera, uv)
    if not frame.rough:
        return d
    at = uv.astype(np.float64)
    return measure_disparity(frame.pair, at, d, surface_slopes(frame.disparity, at))


def known_disparity(disparity: Disparity, camera: RectifiedCamera, uv: Float32) -> Float64:
    """Return the disparity (N,) of features; NaN = unknown, or too small to give a depth."""
    d = sample_disparity(disparity, uv).astype(np.float64)
    return np.where(d + camera.doffs_px < MIN_DISPARITY_PX, np.nan, d)


def replenish(window: TrackWindow, frame: OdometryFrame) -> TrackWindow:
    """Return the window with as many points in each part of the newest frame: some new."""
    window = window.without_newest(in_crowd(window.uvd[-1, :, :2], frame.pair.left.shape))
    taken = window.uvd[-1, window.seen[-1], :2].astype(np.float32)
    uv = (find_fewer_corners if frame.rough else find_corners)(frame.pair.left, taken)
    d = feature_disparity(frame, uv)
    uvd = np.column_stack([uv, d])[np.isfinite(d)]
    return window.with_points(uvd, points_of(uvd, window.T_world_camera[-1], frame.pair.camera))


def points_of(uvd: Float64, T_world_camera: Float64, camera: RectifiedCamera) -> Float64:
    """Return the world points (N, 3) of features with a disparity."""
    depth = depth_from_disparity(uvd[:, 2], camera).astype(np.float64)
    return apply(T_world_camera, unproject(uvd[:, 0], uvd[:, 1], depth, camera))


def empty_window(T_world_camera: Float64) -> TrackWindow:
    """Return a window of one frame without points."""
    return TrackWindow(T_world_camera[None], np.zeros((1, 0, 3)), np.zeros((0, 3)))


def _seen_from(T_world_camera: Float64, xyz_world: Float64, camera: RectifiedCamera) -> Float64:
    """Return column and row (N, 2) of points seen from a pose; NaN behind the camera."""
    u, v, _ = project(apply(invert(T_world_camera), xyz_world), camera)
    return np.stack([u, v], axis=1)
