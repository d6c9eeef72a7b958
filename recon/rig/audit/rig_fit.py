"""A correction of the rig that makes disparities fit the motion, and rows meet.

Bundle adjustment of a few windows that share the correction; poses and points are eliminated.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from itertools import repeat
from typing import Final

import numpy as np

from recon.core.geometry.se3 import apply, invert
from recon.core.values import RectifiedCamera
from recon.core.values.arrays import Float64
from recon.odometry.kernels import bundle
from recon.odometry.window import (
    CAUCHY_SIGMAS,
    SIGMA_D_PX,
    SIGMA_UV_PX,
    TrackWindow,
    adjust,
    normal_equations,
    weighted,
)

_ROUNDS: Final = 6  # times that all windows are adjusted with the places as corrected by then
_ROW_SIGMA_PX: Final = 0.3  # standard deviation of the row of a feature in the right image


@dataclass(frozen=True, eq=False)
class StereoTracks:
    """Tracks in the left images of a window, and the same features in the right ones."""

    window: TrackWindow
    right_uv: Float64  # (W, N, 2), columns and rows; NaN = not found


@dataclass(frozen=True, eq=False)
class CorrectedPlaces:
    """Where features are after a correction, and how that follows its parameters (P).

    Places are float64 (W, N, 2), columns and rows; their derivatives (W, N, 2, P).
    """

    left_uv: Float64
    right_uv: Float64
    by_left: Float64
    by_right: Float64

    @property
    def row_error(self) -> Float64:
        """float64 (W, N), right minus left."""
        return np.asarray(self.right_uv[..., 1] - self.left_uv[..., 1])

    def seen(self, window: TrackWindow) -> TrackWindow:
        """Return a window with the features where they are after the correction."""
        disparity = self.left_uv[..., :1] - self.right_uv[..., :1]
        return replace(window, uvd=np.concatenate([self.left_uv, disparity], axis=2))


@dataclass(frozen=True, eq=False)
class RigCorrection:
    """What may be wrong with a rig, as parameters (P) that are 0 where nothing is."""

    place: Callable[[StereoTracks, Float64], CorrectedPlaces]  # of a window, by the parameters
    prior: Float64  # (P,), what is known beforehand: information that a parameter is 0


@dataclass(frozen=True, eq=False)
class Fitted:
    """A fitted correction (P,), and the normal equations of each window: (K, P, P) and (K, P)."""

    values: Float64
    H: Float64
    g: Float64


def fit_correction(
    tracks: Sequence[StereoTracks], camera: RectifiedCamera, correction: RigCorrection
) -> Fitted:
    """Fit a correction to windows of tracks."""
    prior = correction.prior
    values, windows = np.zeros(len(prior)), [part.window for part in tracks]
    for _ in range(_ROUNDS):
        placed = [correction.place(part, values) for part in tracks]
        windows = [
            adjust(each.seen(window), camera) for each, window in zip(placed, windows, strict=True)
        ]
        systems = map(_system, windows, placed, repeat(camera))
        H, g = (np.stack(parts) for parts in zip(*systems, strict=True))
        step = np.linalg.solve(H.sum(axis=0) + np.diag(prior), g.sum(axis=0) - prior * values)
        values = values + step
    return Fitted(values, H, g - H @ step)


def remaining_cost(
    tracks: Sequence[StereoTracks],
    camera: RectifiedCamera,
    correction: RigCorrection,
    values: Float64,
) -> float:
    """Return what is left of row errors and disparities after a correction, as a robust cost."""
    total = 0.0
    for part in tracks:
        placed = correction.place(part, values)
        residual, _ = weighted(adjust(placed.seen(part.window), camera), camera)
        rows = np.nan_to_num(placed.row_error) / _ROW_SIGMA_PX
        for square in (np.square(residual).sum(axis=2), np.square(rows)):
            total += float(np.log1p(square / CAUCHY_SIGMAS**2).sum())
    return total


def _system(
    window: TrackWindow, placed: CorrectedPlaces, camera: RectifiedCamera
) -> tuple[Float64, Float64]:
    """Return the normal equations (P, P) and (P,) of a further correction, all else eliminated."""
    normal = normal_equations(window, camera)
    shared = _of_places(window, placed, camera)
    rows_H, rows_g = _of_rows(placed)
    frames, points = window.uvd.shape[:2]
    size, parameters = 6 * (frames - 1), placed.by_left.shape[-1]
    # The correction follows the poses, of which the first is fixed, as one more block.
    S, g = np.zeros((size + parameters,) * 2), np.zeros(size + parameters)
    for k in range(1, frames):
        at = slice(6 * (k - 1), 6 * k)
        S[at, at], g[at] = normal.H_pose[k], normal.g_pose[k]
        S[at, size:] = shared.H_pose[k]
        S[size:, at] = shared.H_pose[k].T
    S[size:, size:], g[size:] = shared.H + rows_H, shared.g + rows_g
    of_poses = normal.H_cross[1:].transpose(1, 0, 2, 3).reshape(points, size, 3)
    cross = np.concatenate([of_poses, shared.H_point], axis=1)
    folded = cross @ np.linalg.inv(normal.H_point + bundle.RIDGE * np.eye(3))
    S -= np.einsum("nij,nkj->ik", folded, cross)
    g -= np.einsum("nij,nj->i", folded, normal.g_point)
    share = np.linalg.solve(S[:size, :size] + bundle.RIDGE * np.eye(size), S[:size, size:]).T
    return S[size:, size:] - share @ S[:size, size:], g[size:] - share @ g[:size]


@dataclass(frozen=True, eq=False)
class _Shared:
    """What places say of the correction (P), with the poses (W, 6, P) and points (N, P, 3)."""

    H: Float64
    g: Float64
    H_pose: Float64
    H_point: Float64


def _of_rows(placed: CorrectedPlaces) -> tuple[Float64, Float64]:
    """Return normal equations of the row errors (W, N), which neither pose nor depth changes."""
    residual = np.nan_to_num(placed.row_error) / _ROW_SIGMA_PX
    weight = np.isfinite(placed.row_error) / (1.0 + (residual / CAUCHY_SIGMAS) ** 2)
    J = np.nan_to_num(placed.by_right - placed.by_left)[:, :, 1] / _ROW_SIGMA_PX
    J_weighted = weight[:, :, None] * J
    H = np.einsum("wni,wnj->ij", J_weighted, J)
    # A correction moves the observed row: it is to take the error away.
    return H, -np.einsum("wni,wn->i", J_weighted, residual)


def _of_places(window: TrackWindow, placed: CorrectedPlaces, camera: RectifiedCamera) -> _Shared:
    T_camera_world = invert(window.T_world_camera)
    residual, weight = weighted(window, camera)
    xyz = np.stack([apply(T, window.xyz_world) for T in T_camera_world])
    by_place = _derivative(xyz, camera)
    by_places = [placed.by_left, (placed.by_left - placed.by_right)[:, :, :1]]
    sigmas = np.array([SIGMA_UV_PX, SIGMA_UV_PX, SIGMA_D_PX])
    # A correction moves what is observed, a step what is predicted: hence the sign.
    J = -np.nan_to_num(np.concatenate(by_places, axis=2)) / sigmas[:, None]
    # What has no disparity has no residual and no derivative of one.
    by_place = by_place * np.isfinite(window.uvd)[..., None] / sigmas[:, None]
    by_pose = np.concatenate([-by_place, np.cross(by_place, xyz[:, :, None])], axis=3)
    by_point = by_place @ T_camera_world[:, None, :3, :3]
    J_weighted = weight[:, :, None, None] * J
    return _Shared(
        H=np.einsum("wnki,wnkj->ij", J_weighted, J),
        g=np.einsum("wnki,wnk->i", J_weighted, residual),
        H_pose=np.einsum("wnkp,wnki->wpi", by_pose, J_weighted),
        H_point=np.einsum("wnki,wnkc->nic", J_weighted, by_point),
    )


def _derivative(xyz: Float64, camera: RectifiedCamera) -> Float64:
    """Return how column, row and disparity follow a place in camera axes: (W, N, 3, 3)."""
    f, fb = camera.focal_px, camera.focal_px * camera.baseline_m
    z = np.maximum(xyz[..., 2], bundle.MIN_DEPTH_M)
    x, y, zero = xyz[..., 0] / z, xyz[..., 1] / z, np.zeros_like(z)
    rows = [f / z, zero, -f * x / z], [zero, f / z, -f * y / z], [zero, zero, -fb / z**2]
    return np.stack([np.stack(row, -1) for row in rows], axis=-2)
