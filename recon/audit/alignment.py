"""Row errors of a pair that is said to be rectified, and the small rotation that mends them.

Of the right camera's three rotations two move rows: pitch moves all of them, roll moves them with
the column. Yaw moves columns, which is a disparity like any other: no feature can tell.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import Final

import numpy as np

from recon.geometry.se3 import exp_so3, make_transform
from recon.structures import CameraIntrinsics, RectifiedCamera, StereoCalibration
from recon.structures.arrays import Bool, Float32, Float64

_NEAR_PX: Final = 1.5
"""Features whose rows fit a rotation to this agree with it."""

_TRIALS: Final = 300
_REFITS: Final = 8


@dataclass(frozen=True)
class RowAlignment:
    """Row errors, right minus left, and what is left of them after the best rotation.

    Attributes:
        features: Matched features.
        agreeing: Those that agree with one rotation.
        mean_px: Mean row error of those.
        spread_px: Standard deviation of it.
        rms_px: Root of the mean square: 0 where rows correspond everywhere, noise of the features
            taken away.
        residual_px: Standard deviation after the rotation, robust: the noise of the features.
        pitch_rad: Rotation of the right camera about x that mends the rows.
        roll_rad: Rotation about z.
    """

    features: int
    agreeing: int
    mean_px: float
    spread_px: float
    rms_px: float
    residual_px: float
    pitch_rad: float
    roll_rad: float

    @property
    def rotation(self) -> Float64:
        """float64 (3, 3): takes rays of the right camera to where rows correspond."""
        return exp_so3(np.array([self.pitch_rad, 0.0, self.roll_rad]))

    def turned_rows(self, right_uv: Float32, camera: RectifiedCamera) -> Float64:
        """float64 (N,): rows of features of the right picture when it is mended."""
        turn = np.array([self.pitch_rad, self.roll_rad])
        return np.asarray(turn_features(right_uv, camera, turn)[:, 1])


def align_rows(left_uv: Float32, right_uv: Float32, camera: RectifiedCamera) -> RowAlignment | None:
    """Fit the rotation of the right camera that makes rows correspond.

    Args:
        left_uv: float32 (N, 2), features in the left picture, wrong ones among them.
        right_uv: float32 (N, 2), the same in the right picture.
        camera: The rectified camera.

    Returns:
        None where fewer than a dozen features agree.
    """
    if len(left_uv) < 12:
        return None
    basis, rows = _linear(left_uv, right_uv, camera)
    agree = _consensus(basis, rows, camera.focal_px)
    if agree.sum() < 12:
        return None
    turn = _solve(basis[agree], rows[agree])
    for _ in range(_REFITS):
        # The basis holds for small turns: it is taken anew about the best one so far.
        basis, rows = _linear(left_uv, turn_features(right_uv, camera, turn), camera)
        agree = np.abs(rows) * camera.focal_px < _NEAR_PX
        turn = turn + _solve(basis[agree], rows[agree])
    left_over = left_uv[:, 1] - turn_features(right_uv, camera, turn)[:, 1]
    agree = np.abs(left_over) < _NEAR_PX
    left_over = left_over[agree]
    error = (right_uv[:, 1] - left_uv[:, 1])[agree].astype(np.float64)
    residual = float(1.4826 * np.median(np.abs(left_over - np.median(left_over))))
    noise = float(np.mean(left_over**2))
    return RowAlignment(
        features=len(rows),
        agreeing=int(agree.sum()),
        mean_px=float(error.mean()),
        spread_px=float(error.std()),
        rms_px=float(np.sqrt(max(0.0, np.mean(error**2) - noise))),
        residual_px=residual,
        pitch_rad=float(turn[0]),
        roll_rad=float(turn[1]),
    )


def turn_features(right_uv: Float32, camera: RectifiedCamera, turn: Float64) -> Float64:
    """Where features of the right picture lie when it is turned.

    Args:
        right_uv: float32 (N, 2).
        camera: The rectified camera.
        turn: float64 (2,), pitch and roll, radians.

    Returns:
        float64 (N, 2).
    """
    centre = np.array([camera.cx_right_px, camera.cy_px])
    rays = np.column_stack([(right_uv - centre) / camera.focal_px, np.ones(len(right_uv))])
    turned = rays @ exp_so3(np.array([turn[0], 0.0, turn[1]])).T
    return np.asarray(turned[:, :2] / turned[:, 2:] * camera.focal_px + centre)


def count_aligned(left_uv: Float32, right_uv: Float32, camera: RectifiedCamera) -> int:
    """Number of features that agree with one rotation of the right camera, however large."""
    if len(left_uv) < 2:
        return 0
    return int(_consensus(*_linear(left_uv, right_uv, camera), camera.focal_px).sum())


def mend_rig(
    rig: RectifiedCamera | StereoCalibration, alignment: RowAlignment, R_rect_left: Float64
) -> StereoCalibration:
    """The calibration with the right camera turned so that rows correspond; it stays in its place.

    Args:
        rig: The calibration that the pictures were rectified with.
        alignment: Row errors of the rectified pictures.
        R_rect_left: float64 (3, 3), rotation from the left camera to the rectified one; the
            identity for a rig that is rectified.
    """
    raw = _as_raw(rig)
    R, t = raw.T_right_left[:3, :3], raw.T_right_left[:3, 3]
    centre = -R.T @ t
    # Rectified right rays are R_rect_left @ R.T @ ray; the alignment turns them once more.
    turned = R @ R_rect_left.T @ alignment.rotation.T @ R_rect_left
    return replace(raw, T_right_left=make_transform(turned, -turned @ centre))


def _as_raw(rig: RectifiedCamera | StereoCalibration) -> StereoCalibration:
    if isinstance(rig, StereoCalibration):
        return rig
    right = rig.matrix.copy()
    right[0, 2] = rig.cx_right_px
    cameras = [
        CameraIntrinsics(matrix, np.zeros(0), rig.width_px, rig.height_px)
        for matrix in (rig.matrix, right)
    ]
    T_right_left = make_transform(np.eye(3), np.array([-rig.baseline_m, 0.0, 0.0]))
    return StereoCalibration(cameras[0], cameras[1], T_right_left)


def _linear(
    left_uv: Float32, right_uv: Float32 | Float64, camera: RectifiedCamera
) -> tuple[Float64, Float64]:
    """Basis (N, 2) and target (N,) of ``rows = basis @ (pitch, roll)``, in focal lengths.

    A small turn w moves a ray p by w × p; its row then is y - w_x·(1 + y²) + w_z·x.
    """
    x = (right_uv[:, 0].astype(np.float64) - camera.cx_right_px) / camera.focal_px
    y = (right_uv[:, 1].astype(np.float64) - camera.cy_px) / camera.focal_px
    rows = (left_uv[:, 1].astype(np.float64) - right_uv[:, 1]) / camera.focal_px
    return np.stack([-(1 + y * y), x], axis=1), rows


def _solve(basis: Float64, rows: Float64) -> Float64:
    """float64 (2,): pitch and roll of least squares."""
    return np.asarray(np.linalg.lstsq(basis, rows, rcond=None)[0], dtype=np.float64)


def _consensus(basis: Float64, rows: Float64, focal_px: float) -> Bool:
    """bool (N,): the largest set of features that agree with one turn, of many tried by two."""
    rng = np.random.default_rng(0)
    pick = rng.integers(0, len(rows), (_TRIALS, 2))
    a, b = basis[pick[:, 0]], basis[pick[:, 1]]
    det = a[:, 0] * b[:, 1] - a[:, 1] * b[:, 0]
    # Two features in one column tell nothing of roll.
    good = np.abs(det) > 0.05
    a, b, det = a[good], b[good], det[good]
    first, second = rows[pick[good, 0]], rows[pick[good, 1]]
    turns = np.stack(
        [
            (first * b[:, 1] - second * a[:, 1]) / det,
            (a[:, 0] * second - b[:, 0] * first) / det,
        ]
    )
    turns = np.concatenate([turns, np.zeros((2, 1))], axis=1)
    near = np.abs(basis @ turns - rows[:, None]) * focal_px < _NEAR_PX
    return np.asarray(near[:, int(np.argmax(near.sum(axis=0)))])
