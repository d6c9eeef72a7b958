"""Epipolar errors of a rectified pair, and the small rotation that corrects them.

Pitch of the right camera moves all rows alike, roll in proportion to the column. Yaw moves columns,
which cannot be distinguished from disparity.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import Final

import numpy as np

from recon.core.geometry.se3 import exp_so3, make_transform
from recon.core.values import CameraIntrinsics, RectifiedCamera, Rig, StereoCalibration
from recon.core.values.arrays import Bool, Float32, Float64

_NEAR_PX: Final = 1.5  # features with a smaller epipolar error after a rotation agree with it
_TRIALS: Final = 300
_REFITS: Final = 8


@dataclass(frozen=True)
class EpipolarAlignment:
    """Epipolar errors (right minus left), and the rotation of the right camera that helps."""

    agreeing: int  # number of features that agree with the rotation
    mean_px: float  # mean epipolar error of the agreeing features
    spread_px: float  # standard deviation of their epipolar error
    rms_px: (
        float  # root mean square epipolar error without the feature noise; 0 if rows are aligned
    )
    residual_px: float  # robust standard deviation after the rotation: the feature noise
    pitch_rad: float  # correcting rotation about x
    roll_rad: float  # correcting rotation about z

    @property
    def turn(self) -> Float64:
        """What aligns the rows, as `correct_rig` takes it."""
        return np.array([self.pitch_rad, 0.0, self.roll_rad, 0.0])

    def turned_rows(self, right_uv: Float32, camera: RectifiedCamera) -> Float64:
        """Return float64 (N,): rows of features of the right image after correction."""
        return np.asarray(turn_features(right_uv, camera, self.turn[[0, 2]])[:, 1])


def align_epipolar(
    left_uv: Float32, right_uv: Float32, camera: RectifiedCamera
) -> EpipolarAlignment | None:
    """Fit the rotation of the right camera that aligns the rows of features (N, 2).

    Some of them may be wrong matches. None if fewer than 12 agree.
    """
    if len(left_uv) < 12:
        return None
    basis, rows = _linear(left_uv, right_uv, camera)
    agree = _consensus(basis, rows, camera.focal_px)
    if agree.sum() < 12:
        return None
    turn = _solve(basis[agree], rows[agree])
    for _ in range(_REFITS):
        # The basis is valid for small rotations: linearise again at the best one so far.
        basis, rows = _linear(left_uv, turn_features(right_uv, camera, turn), camera)
        agree = np.abs(rows) * camera.focal_px < _NEAR_PX
        turn = turn + _solve(basis[agree], rows[agree])
    left_over = left_uv[:, 1] - turn_features(right_uv, camera, turn)[:, 1]
    agree = np.abs(left_over) < _NEAR_PX
    if agree.sum() < 12:
        return None
    left_over = left_over[agree]
    error = (right_uv[:, 1] - left_uv[:, 1])[agree].astype(np.float64)
    noise = float(np.mean(left_over**2))
    return EpipolarAlignment(
        agreeing=int(agree.sum()),
        mean_px=float(error.mean()),
        spread_px=float(error.std()),
        rms_px=float(np.sqrt(max(0.0, np.mean(error**2) - noise))),
        residual_px=float(1.4826 * np.median(np.abs(left_over - np.median(left_over)))),
        pitch_rad=float(turn[0]),
        roll_rad=float(turn[1]),
    )


def turn_features(right_uv: Float32, camera: RectifiedCamera, turn: Float64) -> Float64:
    """Return where features (N, 2) of the right image are after a pitch and roll, radians."""
    centre = np.array([camera.cx_right_px, camera.cy_px])
    rays = np.column_stack([(right_uv - centre) / camera.focal_px, np.ones(len(right_uv))])
    turned = rays @ exp_so3(np.array([turn[0], 0.0, turn[1]])).T
    return np.asarray(turned[:, :2] / turned[:, 2:] * camera.focal_px + centre)


def count_aligned(left_uv: Float32, right_uv: Float32, camera: RectifiedCamera) -> int:
    """Return how many features agree with one rotation of the right camera, however large."""
    if len(left_uv) < 2:
        return 0
    return int(_consensus(*_linear(left_uv, right_uv, camera), camera.focal_px).sum())


def as_raw(rig: Rig) -> StereoCalibration:
    """Return a rectified rig as two cameras without distortion."""
    if isinstance(rig, StereoCalibration):
        return rig
    left, right = (
        CameraIntrinsics(matrix, np.zeros(0), rig.width_px, rig.height_px)
        for matrix in (rig.matrix, rig.right_matrix)
    )
    beside = make_transform(np.eye(3), np.array([-rig.baseline_m, 0.0, 0.0]))
    return StereoCalibration(left, right, beside)


def correct_rig(rig: Rig, turn: Float64, R_rect_left: Float64) -> StereoCalibration:
    """Return the calibration with the right camera turned in place, and its focal length changed.

    ``turn`` (4,) is pitch, yaw and roll, radians, of rays of the rectified right camera, and the
    share by which its image is enlarged; ``R_rect_left`` the rotation from the left camera to the
    rectified one, the identity for a rectified rig.
    """
    raw = as_raw(rig)
    R, t = raw.T_right_left[:3, :3], raw.T_right_left[:3, 3]
    centre = -R.T @ t
    # Rectified right rays are R_rect_left @ R.T @ ray; the correction turns them further.
    turned = R @ R_rect_left.T @ exp_so3(turn[:3]).T @ R_rect_left
    # An image that is to be enlarged is that of a shorter focal length than was believed.
    matrix = raw.right.matrix.copy()
    matrix[[0, 1], [0, 1]] /= 1.0 + turn[3]
    T_right_left = make_transform(turned, -turned @ centre)
    return replace(raw, right=replace(raw.right, matrix=matrix), T_right_left=T_right_left)


def _linear(
    left_uv: Float32, right_uv: Float32 | Float64, camera: RectifiedCamera
) -> tuple[Float64, Float64]:
    """Return basis (N, 2) and target (N,) of ``rows = basis @ (pitch, roll)``, in focal lengths.

    A small rotation w moves a ray p by w × p; its row becomes y - w_x·(1 + y²) + w_z·x.
    """
    x = (right_uv[:, 0].astype(np.float64) - camera.cx_right_px) / camera.focal_px
    y = (right_uv[:, 1].astype(np.float64) - camera.cy_px) / camera.focal_px
    rows = (left_uv[:, 1].astype(np.float64) - right_uv[:, 1]) / camera.focal_px
    return np.stack([-(1 + y * y), x], axis=1), rows


def _solve(basis: Float64, rows: Float64) -> Float64:
    return np.asarray(np.linalg.lstsq(basis, rows, rcond=None)[0], dtype=np.float64)


def _consensus(basis: Float64, rows: Float64, focal_px: float) -> Bool:
    """Return bool (N,), the largest set of features that agree with one rotation (RANSAC)."""
    rng = np.random.default_rng(0)
    pick = rng.integers(0, len(rows), (_TRIALS, 2))
    a, b = basis[pick[:, 0]], basis[pick[:, 1]]
    det = a[:, 0] * b[:, 1] - a[:, 1] * b[:, 0]
    # Two features in nearly the same column do not determine roll.
    good = np.abs(det) > 0.05
    a, b, det = a[good], b[good], det[good]
    first, second = rows[pick[good, 0]], rows[pick[good, 1]]
    pitch = (first * b[:, 1] - second * a[:, 1]) / det
    roll = (a[:, 0] * second - b[:, 0] * first) / det
    turns = np.concatenate([np.stack([pitch, roll]), np.zeros((2, 1))], axis=1)
    near = np.abs(basis @ turns - rows[:, None]) * focal_px < _NEAR_PX
    return np.asarray(near[:, int(np.argmax(near.sum(axis=0)))])
