"""The turn of the right camera that makes disparities fit the motion, and rows meet.

Bundle adjustment of a few windows, with the turn as one more unknown that all windows share. Poses
and points are eliminated, so that each window says something of the turn alone.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Final

import numpy as np

from recon.core.geometry.se3 import apply, invert
from recon.core.values import RectifiedCamera
from recon.core.values.arrays import Float64
from recon.odometry.kernels import bundle
from recon.odometry.window import (
    CAUCHY_SIGMAS,
    SIGMA_D_PX,
    TrackWindow,
    adjust,
    normal_equations,
    weighted,
)

_ROUNDS: Final = 6
"""Times that all windows are adjusted with the disparities as corrected by then."""

_ROW_SIGMA_PX: Final = 0.3
"""Standard deviation of the row of a feature in the right image."""

MIN_WINDOWS: Final = 6
"""Fewer windows do not show how much their answers scatter."""

_PARAMETERS: Final = 5
"""Pitch, yaw, roll, focal length, lenses."""

_TELLING_SIGMAS: Final = 2.0
"""What is nearer to zero than this is left as it is calibrated."""


@dataclass(frozen=True, eq=False)
class RightTurn:
    """What corrects the right camera: it is turned in place, and its image is enlarged.

    Attributes:
        values: float64 (5,): pitch, yaw and roll, radians, by which rays are turned about x, y
            and z; the share by which the image is enlarged about the principal point; and what
            lenses bend: the shift of columns at 45° from the axis, in focal lengths.
        covariance: float64 (5, 5), of the values.
        windows: Number of windows they are from.
    """

    values: Float64
    covariance: Float64
    windows: int

    @property
    def sigmas(self) -> Float64:
        """float64 (5,), standard deviations of the values.

        Lenses that are known to bend columns may bend them by as much in other ways, which yaw and
        focal length then stand for.
        """
        sigmas = np.sqrt(np.diag(self.covariance))
        sigmas[[1, 3]] = np.hypot(sigmas[[1, 3]], self.values[4])
        return np.asarray(sigmas)

    @property
    def telling(self) -> Float64:
        """float64 (4,): pitch, yaw, roll and enlargement, 0 where the drive does not show them."""
        shown = np.abs(self.values) > _TELLING_SIGMAS * self.sigmas
        return np.where(shown, self.values, 0.0)[:4]


@dataclass(frozen=True, eq=False)
class StereoTracks:
    """Tracks in the left images of a window, and the same features in the right ones.

    Attributes:
        window: Poses, points and their places in the left images.
        right_uv: float64 (W, N, 2), columns and rows in the right images; NaN = not found.
    """

    window: TrackWindow
    right_uv: Float64


def estimate_turn(tracks: Sequence[StereoTracks], camera: RectifiedCamera) -> RightTurn | None:
    """Estimate the turn of the right camera that makes disparities fit the motion, and rows meet.

    The covariance is that of the windows' answers: what one window gets wrong as a whole, such as
    what drives beside it, counts once and not once a feature.

    Returns:
        None if there are too few windows.

    Ref:
        Liang and Zeger, "Longitudinal data analysis using generalized linear models", 1986 (the
        covariance of clustered data).
    """
    if len(tracks) < MIN_WINDOWS:
        return None
    turn, windows = np.zeros(_PARAMETERS), [part.window for part in tracks]
    for _ in range(_ROUNDS):
        seen = [_observed(part, turn, camera) for part in tracks]
        windows = [
            adjust(replace(window, uvd=uvd), camera)
            for window, (uvd, _) in zip(windows, seen, strict=True)
        ]
        systems = [
            _system(window, rows, part.right_uv, camera)
            for window, (_, rows), part in zip(windows, seen, tracks, strict=True)
        ]
        H, g = (np.stack(parts) for parts in zip(*systems, strict=True))
        step = np.linalg.solve(H.sum(axis=0), g.sum(axis=0))
        turn = turn + step
    left_over = g - H @ step
    inverse = np.linalg.inv(H.sum(axis=0))
    scatter = left_over.T @ left_over * len(tracks) / (len(tracks) - _PARAMETERS)
    return RightTurn(turn, inverse @ scatter @ inverse, len(tracks))


def _observed(
    tracks: StereoTracks, turn: Float64, camera: RectifiedCamera
) -> tuple[Float64, Float64]:
    """Return columns, rows and disparities (W, N, 3), and row errors (W, N), after a turn."""
    uv = tracks.window.uvd[:, :, :2]
    right = turned_places(tracks.right_uv, turn, camera)
    disparity = uv[:, :, :1] - right[:, :, :1]
    return np.concatenate([uv, disparity], axis=2), right[:, :, 1] - uv[:, :, 1]


def _system(
    window: TrackWindow, row_error: Float64, right_uv: Float64, camera: RectifiedCamera
) -> tuple[Float64, Float64]:
    """Return the normal equations of a further turn, poses and points eliminated.

    Returns:
        float64 (5, 5) and (5,).
    """
    normal = normal_equations(window, camera)
    by_turn = camera.focal_px * np.nan_to_num(_basis(right_uv, camera))
    rows_H, rows_g = _of_rows(row_error, by_turn[:, :, 1])
    columns = _of_columns(window, by_turn[:, :, 0], camera)
    frames, points = window.uvd.shape[:2]
    size = 6 * (frames - 1)
    # The turn follows the poses, of which the first is fixed, as one more block.
    S, g = np.zeros((size + _PARAMETERS,) * 2), np.zeros(size + _PARAMETERS)
    for k in range(1, frames):
        at = slice(6 * (k - 1), 6 * k)
        S[at, at], g[at] = normal.H_pose[k], normal.g_pose[k]
        S[at, size:] = columns.H_pose[k]
        S[size:, at] = columns.H_pose[k].T
    S[size:, size:], g[size:] = columns.H + rows_H, columns.g + rows_g
    of_poses = normal.H_cross[1:].transpose(1, 0, 2, 3).reshape(points, size, 3)
    cross = np.concatenate([of_poses, columns.H_point], axis=1)
    folded = cross @ np.linalg.inv(normal.H_point + bundle.RIDGE * np.eye(3))
    S -= np.einsum("nij,nkj->ik", folded, cross)
    g -= np.einsum("nij,nj->i", folded, normal.g_point)
    share = np.linalg.solve(S[:size, :size] + bundle.RIDGE * np.eye(size), S[:size, size:]).T
    return S[size:, size:] - share @ S[:size, size:], g[size:] - share @ g[:size]


@dataclass(frozen=True, eq=False)
class _Columns:
    """What disparities say of the turn (T), with the poses and points that share them.

    Attributes:
        H: float64 (5, 5).
        g: float64 (5,).
        H_pose: float64 (W, 6, 5).
        H_point: float64 (N, 5, 3).
    """

    H: Float64
    g: Float64
    H_pose: Float64
    H_point: Float64


def _of_rows(error: Float64, by_turn: Float64) -> tuple[Float64, Float64]:
    """Return normal equations of the row errors (W, N), which neither pose nor depth changes."""
    residual = np.nan_to_num(error) / _ROW_SIGMA_PX
    weight = np.isfinite(error) / (1.0 + (residual / CAUCHY_SIGMAS) ** 2)
    J = by_turn / _ROW_SIGMA_PX
    J_weighted = weight[:, :, None] * J
    H = np.einsum("wni,wnj->ij", J_weighted, J)
    # A turn moves the observed row: it is to take the error away.
    return H, -np.einsum("wni,wn->i", J_weighted, residual)


def _of_columns(window: TrackWindow, by_turn: Float64, camera: RectifiedCamera) -> _Columns:
    T_camera_world = invert(window.T_world_camera)
    residual, weight = weighted(window, camera)
    xyz = np.stack([apply(T, window.xyz_world) for T in T_camera_world])
    z = np.maximum(xyz[:, :, 2], bundle.MIN_DEPTH_M)
    by_z = -camera.focal_px * camera.baseline_m / z**2 / SIGMA_D_PX
    known = np.isfinite(window.uvd[:, :, 2])
    weight = weight * known
    J = by_turn / SIGMA_D_PX
    zero = np.zeros_like(z)
    by_pose = np.stack([zero, zero, -by_z, -by_z * xyz[:, :, 1], by_z * xyz[:, :, 0], zero], -1)
    by_point = by_z[:, :, None] * T_camera_world[:, None, 2, :3]
    J_weighted = weight[:, :, None] * J
    return _Columns(
        H=np.einsum("wni,wnj->ij", J_weighted, J),
        g=np.einsum("wni,wn->i", J_weighted, np.nan_to_num(residual[:, :, 2])),
        H_pose=np.einsum("wnp,wnt->wpt", by_pose, J_weighted),
        H_point=np.einsum("wnt,wnc->ntc", J_weighted, by_point),
    )


def turned_places(right_uv: Float64, turn: Float64, camera: RectifiedCamera) -> Float64:
    """Return where features (…, 2) of the right image are after a turn (5,), to first order."""
    return right_uv + camera.focal_px * (_basis(right_uv, camera) @ turn)


def _basis(uv: Float64, camera: RectifiedCamera) -> Float64:
    """Return what a turn does to places (…, 2) in the right image: float64 (…, 2, 5).

    A small rotation w moves a ray p by w × p.
    """
    x, y = np.moveaxis((uv - [camera.cx_right_px, camera.cy_px]) / camera.focal_px, -1, 0)
    columns = np.stack([-x * y, 1 + x * x, -y, x, x * x], axis=-1)
    rows = np.stack([-(1 + y * y), x * y, x, y, np.zeros_like(x)], axis=-1)
    return np.stack([columns, rows], axis=-2)
