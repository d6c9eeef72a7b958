"""Features of visual odometry: found, followed, and found again where a motion puts them.

Tracking looks for a patch as it was. From one frame to the next a patch on a near surface grows by
half or slants, and is lost; but near features alone fix how far the camera moved. Far ones say it
only as well as the rig is calibrated: a quarter of a pixel is 1 % of the depth at 15 m.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Final

import cv2
import numpy as np
from numpy.typing import NDArray

from recon.core.geometry.se3 import Motion, apply, invert
from recon.core.values import Disparity, Rectified, RectifiedCamera, RectifiedPair
from recon.core.values.arrays import Bool, Float32, Float64, UInt8
from recon.core.values.camera import depth_from_disparity, project, unproject
from recon.odometry.kernels.patches import Placing, Surface, fit_slopes, place_patches
from recon.odometry.pose import REPROJECTION_PX, TrackWindow
from recon.odometry.protocol import OdometryFrame
from recon.stereo.match.sad import halve

MIN_DISPARITY_PX: Final = 0.5  # features with less disparity count as without depth


@dataclass(frozen=True, eq=False)
class VisualState:
    """What is kept from frame to frame."""

    window: TrackWindow  # the last frames that were registered, and the points in them
    left: UInt8  # (H, W), the left image of the newest of them
    disparity: Disparity  # its disparity
    motion: Motion  # pose and motion by now, which may be some frames later
    seen: Motion  # those of the newest frame that was registered


def follow_points(state: VisualState, frame: OdometryFrame, predicted: Float64) -> Float64:
    """The points of the window in the new frame, tracked: column and row (N, 2), NaN where lost."""
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
    """Column, row and disparity (N, 3) of the window's points in a frame of known pose.

    They are looked for near where tracking found them (``followed`` (N, 2), NaN = nowhere), or else
    where the pose puts them, and as they look from there.
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
    uvd[there, 2] = known_disparity(frame.disparity, camera, uv_now)
    return uvd


def told_apart(state: VisualState, one: Float64, other: Float64, camera: RectifiedCamera) -> Bool:
    """The points (N,) seen last that two poses put too far apart to be found at the same place."""
    xyz_world = state.window.xyz_world
    apart = np.abs(_seen_from(one, xyz_world, camera) - _seen_from(other, xyz_world, camera))
    return np.asarray(state.window.seen[-1] & ~(apart.max(axis=1) <= _PLACING.reach))


def known_disparity(disparity: Disparity, camera: RectifiedCamera, uv: Float32) -> Float64:
    """Return the disparity (N,) of features; NaN = unknown, or too small to give a depth."""
    d = _sampled(disparity, uv).astype(np.float64)
    return np.where(d + camera.doffs_px < MIN_DISPARITY_PX, np.nan, d)


def replenish(window: TrackWindow, frame: OdometryFrame) -> TrackWindow:
    """The window with new points in those parts of the newest frame that have few."""
    window = window.without_newest(in_crowd(window.uvd[-1, :, :2], frame.pair.left.shape))
    taken = window.uvd[-1, window.seen[-1], :2].astype(np.float32)
    uv = (find_fewer_corners if frame.rough else find_corners)(frame.pair.left, taken)
    d = known_disparity(frame.disparity, frame.pair.camera, uv)
    uvd = np.column_stack([uv, d])[np.isfinite(d)]
    return window.with_points(uvd, points_of(uvd, window.T_world_camera[-1], frame.pair.camera))


def points_of(uvd: Float64, T_world_camera: Float64, camera: RectifiedCamera) -> Float64:
    """The world points (N, 3) of features with a disparity."""
    depth = depth_from_disparity(uvd[:, 2], camera).astype(np.float64)
    return apply(T_world_camera, unproject(uvd[:, 0], uvd[:, 1], depth, camera))


def empty_window(T_world_camera: Float64) -> TrackWindow:
    """A window of one frame without points."""
    return TrackWindow(T_world_camera[None], np.zeros((1, 0, 3)), np.zeros((0, 3)))


def _seen_from(T_world_camera: Float64, xyz_world: Float64, camera: RectifiedCamera) -> Float64:
    """Column and row (N, 2) of points seen from a pose; NaN behind the camera."""
    u, v, _ = project(apply(invert(T_world_camera), xyz_world), camera)
    return np.stack([u, v], axis=1)


_WINDOW_PX: Final = 17  # edge of the tracked patch
_LEVELS: Final = 3  # pyramid levels above full resolution
_NEIGHBOUR_PX: Final = 2  # half width of the neighbourhood whose median is the disparity
_MAX_DISPARITY_STEP_PX: Final = 1.0  # largest difference between a disparity and that median
_MIN_EIGENVALUE: Final = 1e-4  # least texture of a patch that is tracked, OpenCV's scale


def follow(source: UInt8, target: UInt8, uv: Float32, guess_uv: Float32) -> tuple[Float32, Bool]:
    """Track features to another image, roughly: as patches that look the same.

    Returns their columns and rows (N, 2) in the target, and bool (N,), where something was found;
    part of it is wrong. ``guess_uv`` is where they are expected.

    Ref: Bouguet, "Pyramidal implementation of the Lucas Kanade feature tracker", 2001.
    """
    if not len(uv):
        return uv.copy(), np.zeros(0, np.bool_)
    source, target = _evened(source), _evened(target)
    end = (cv2.TERM_CRITERIA_COUNT | cv2.TERM_CRITERIA_EPS, 10, 0.05)
    there, status, _ = cv2.calcOpticalFlowPyrLK(
        source,
        target,
        uv.reshape(-1, 1, 2),
        guess_uv.reshape(-1, 1, 2).copy(),
        winSize=(_WINDOW_PX, _WINDOW_PX),
        maxLevel=_LEVELS,
        criteria=end,
        flags=cv2.OPTFLOW_USE_INITIAL_FLOW,
        minEigThreshold=_MIN_EIGENVALUE,
    )
    there, found = there.reshape(-1, 2), status.ravel().astype(np.bool_)
    height, width = target.shape
    inside = (there >= 0).all(axis=1) & (there[:, 0] <= width - 1) & (there[:, 1] <= height - 1)
    return there, np.asarray(found & inside)


def _evened(grey: UInt8) -> UInt8:
    """An image over its mean around each pixel, 128 = as bright: whatever the light is there.

    Else patches on an edge slide along it to where it is as bright: all alike, as by a motion.
    """
    mean = cv2.boxFilter(grey, cv2.CV_32F, (2 * _WINDOW_PX - 1, 2 * _WINDOW_PX - 1))
    return np.asarray(cv2.divide(grey, cv2.max(mean, 1.0), scale=128.0, dtype=cv2.CV_8U))


def _sampled(disparity: Disparity, uv: Float32) -> Float32:
    """The median (N,) of the disparities around features; NaN = none, or inconsistent.

    Tracking features into the right image instead gave two to four times the drift on real drives,
    probably because patches at the edge of an object contain the background, too.
    """
    around, centre = values_around(disparity.values, uv, _NEIGHBOUR_PX)
    middle = np.median(around, axis=1)
    agrees = np.abs(middle - centre) <= _MAX_DISPARITY_STEP_PX
    sampled: Float32 = np.where(agrees, middle, np.nan).astype(np.float32)
    return sampled


def values_around(values: Float32, uv: Float32, reach_px: int) -> tuple[Float32, Float32]:
    """Values (N, K) in squares around places (N, 2), the nearest (N,) where one is NaN; and it."""
    column, row = np.rint(uv).astype(np.int64).T
    offset = np.arange(-reach_px, reach_px + 1)
    columns = np.clip(column[:, None, None] + offset, 0, values.shape[1] - 1)
    rows = np.clip(row[:, None, None] + offset[:, None], 0, values.shape[0] - 1)
    around = values[rows, columns].reshape(len(uv), offset.size**2)
    centre = around[:, offset.size**2 // 2]
    return np.where(np.isfinite(around), around, centre[:, None]), centre


_CELL_PX: Final = 40  # edge of a cell of the image
_PER_CELL: Final = 3  # corners that a cell may hold
_DISTANCE_PX: Final = 6  # least distance between two corners
_BLOCK_PX: Final = 5  # edge of the neighbourhood that the corner score is computed in
_MIN_SCORE: Final = 2e-4  # least eigenvalue of the gradients' covariance, OpenCV's scale
_BORDER_PX: Final = 8  # corners nearer to the border are not used


def find_corners(
    grey: UInt8, taken_uv: Float32, *, cell_px: int = _CELL_PX, per_cell: int = _PER_CELL
) -> Float32:
    """The best corners (M, 2) of each cell of an image, away from those taken.

    Cells keep one strongly textured region from taking all features: only features spread over the
    image determine the motion well. Those already tracked count towards the limit of their cell.

    Ref: Shi and Tomasi, "Good features to track", CVPR 1994.
    """
    score = cv2.cornerMinEigenVal(grey, _BLOCK_PX, ksize=3)
    size = 2 * _DISTANCE_PX + 1
    peak = score >= cv2.dilate(score, np.ones((size, size), np.uint8))
    peak &= (score > _MIN_SCORE) & _free(grey.shape, taken_uv)
    inside = np.zeros_like(peak)
    inside[_BORDER_PX:-_BORDER_PX, _BORDER_PX:-_BORDER_PX] = True
    # Over a whole image, `nonzero` takes six times as long.
    v, u = np.divmod(np.flatnonzero(peak & inside), grey.shape[1])
    cells = _cell_of(np.stack([u, v], axis=1), grey.shape, cell_px)
    order = np.lexsort((u, v, -score[v, u], cells))
    rank = _rank_in_group(cells[order])
    count = -(-grey.shape[0] // cell_px) * -(-grey.shape[1] // cell_px)
    taken = np.bincount(_cell_of(taken_uv, grey.shape, cell_px), minlength=count)
    missing = per_cell - taken
    keep = order[rank < missing[cells[order]]]
    return np.stack([u[keep], v[keep]], axis=1).astype(np.float32)


def in_crowd(uv: Float64, shape: tuple[int, ...]) -> Bool:
    """Which features (N, 2) are more than their cell may hold; those that come first stay.

    Where a camera drives backwards, or turns away, features that are followed gather far ahead, and
    would outnumber those that are near. Features that are not seen (NaN) are in no crowd.
    """
    crowd, seen = np.zeros(len(uv), np.bool_), np.flatnonzero(np.isfinite(uv[:, 0]))
    cells = _cell_of(uv[seen], shape, _CELL_PX)
    order = np.argsort(cells, kind="stable")
    crowd[seen[order]] = _rank_in_group(cells[order]) >= _PER_CELL
    return crowd


def find_fewer_corners(grey: UInt8, taken_uv: Float32) -> Float32:
    """Corners like `find_corners`, a third as many, found at half size.

    Finding and using them takes a quarter of the time: for drives that are mapped live.
    """
    taken = (0.5 * (taken_uv - np.float32(0.5))).astype(np.float32)
    cells = {"cell_px": _CELL_PX * 3 // 5, "per_cell": _PER_CELL - 1}
    return np.asarray(2 * find_corners(halve(grey), taken, **cells) + np.float32(0.5))


def _free(shape: tuple[int, ...], taken_uv: Float32) -> Bool:
    """Pixels away from every feature already tracked."""
    free = np.ones(shape, np.uint8)
    for u, v in np.rint(taken_uv).astype(int).tolist():
        cv2.circle(free, (u, v), _DISTANCE_PX, 0, -1)
    return free.astype(np.bool_)


def _cell_of(uv: NDArray[np.generic], shape: tuple[int, ...], size: int) -> NDArray[np.int64]:
    columns = -(-shape[1] // size)
    u = np.clip(np.rint(uv[:, 0]).astype(np.int64), 0, shape[1] - 1)
    v = np.clip(np.rint(uv[:, 1]).astype(np.int64), 0, shape[0] - 1)
    cell: NDArray[np.int64] = (v // size) * columns + u // size
    return cell


def _rank_in_group(groups: NDArray[np.int64]) -> NDArray[np.int64]:
    """The position of each element within its run of equal values."""
    index = np.arange(len(groups))
    starts = np.r_[True, groups[1:] != groups[:-1]] if len(groups) else np.zeros(0, np.bool_)
    rank: NDArray[np.int64] = index - np.maximum.accumulate(np.where(starts, index, 0))
    return rank


_PLACING: Final = Placing(radius=6, steps=10, close=0.03, reach=3.0)
"""Patches of 13 pixels, within 3 pixels of where the motion says."""

_MIN_CORRELATION: Final = 0.75  # least correlation of a patch with the one it is found as
_SURFACE: Final = Surface(radius=6, step=2, near=1.0, least=6, rounds=3)
"""Every second row and column is taken, as neighbours share their windows anyhow."""


def find_again(
    source: UInt8, target: UInt8, uv: Float64, warp: Float64, guess_uv: Float64
) -> Float64:
    """Find warped patches of one image in another, near a guess; NaN where nothing is alike.

    ``warp`` (N, 2, 2) says what becomes of a small offset; ``guess_uv`` (N, 2) where they should
    be.
    """
    place, correlation = place_patches(source, target, uv, warp, guess_uv, _PLACING)
    with np.errstate(invalid="ignore"):
        alike = correlation >= _MIN_CORRELATION
    return np.where(alike[:, None], place, np.nan)


def warp_of(
    uv: Float64, xyz: Float64, slope: Float64, T_target_source: Float64, camera: RectifiedCamera
) -> Float64:
    """What a motion makes of small offsets around features: float64 (N, 2, 2).

    A surface of which the disparity changes linearly is a plane, and its image after a motion is a
    homography of the one before; this is its derivative. ``slope`` (N, 2) is the change of the
    surface's disparity per pixel to the right and down, ``xyz`` (N, 3) in the axes of the source.

    Ref: Hartley and Zisserman, "Multiple view geometry", 2nd ed., section 13.1.
    """
    moved = apply(T_target_source, xyz) / xyz[:, 2:]
    R, t = T_target_source[:3, :3], T_target_source[:3, 3]
    # Along the row and the column: of the ray, and of the inverse depth times the translation.
    by_offset = R[:, :2] + slope[:, None, :] / camera.baseline_m * t[:, None]
    image = moved[:, :2] / moved[:, 2:]
    return np.asarray(
        (by_offset[:, :2] - image[:, :, None] * by_offset[:, 2:]) / moved[:, 2:, None]
    )


def find_in_right(pair: Rectified, uv: Float64, near: Float64, slope: Float64) -> Float64:
    """Columns and rows (N, 2) of features in the right image, near a disparity (N,), or NaN.

    NaN where nothing alike is found; ``slope`` as in `warp_of`. For what a rig is fitted to: for
    poses, disparities of windows on one row are better where the rig is not quite as calibrated.
    """
    if not isinstance(pair, RectifiedPair):  # there is none: only its disparity says where
        return uv - near[:, None] * [1.0, 0.0]
    warp = np.tile(np.eye(2), (len(uv), 1, 1))
    warp[:, 0] -= slope
    return find_again(pair.left, pair.right, uv, warp, uv - near[:, None] * [1.0, 0.0])


def surface_slopes(disparity: Disparity, uv: Float64) -> Float64:
    """Slopes of the disparity around features: float64 (N, 2), per pixel right and down.

    A plane is fitted to the neighbours that lie on it; 0 where there are too few.
    """
    return fit_slopes(disparity.values, uv, _SURFACE)
