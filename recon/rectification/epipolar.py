"""Where in the other picture the partner of a pixel must lie."""

from __future__ import annotations

from typing import Final

import numpy as np

from recon.adapters.opencv_lens import project_into_picture, unproject
from recon.geometry.se3 import apply, invert
from recon.structures import CameraIntrinsics, StereoCalibration
from recon.structures.arrays import Float64

# Depths along a ray, in baselines: from closer than any rig sees to as good as infinity.
_DEPTHS: Final = np.geomspace(0.5, 1e4, 400)


def epipolar_curves(
    calibration: StereoCalibration, left_px: Float64, right_px: Float64
) -> tuple[list[Float64], list[Float64]]:
    """Epipolar lines in the raw pictures; lenses bend them.

    Args:
        calibration: The raw rig.
        left_px: float64 (N, 2), pixels of the left picture.
        right_px: float64 (N, 2), pixels of the right picture.

    Returns:
        For each right pixel its curve (M, 2) in the left picture, and for each left pixel its
        curve in the right one; NaN where a curve leaves the picture.
    """
    T, near = calibration.T_right_left, calibration.baseline_m
    left, right = calibration.left, calibration.right
    in_left = [_curve(right, left, invert(T), pixel, near) for pixel in right_px]
    in_right = [_curve(left, right, T, pixel, near) for pixel in left_px]
    return in_left, in_right


def epipolar_lines(
    fundamental: Float64, left_px: Float64, right_px: Float64, size: tuple[int, int]
) -> tuple[list[Float64], list[Float64]]:
    """The same for plain pinholes by their fundamental matrix, ``right.T @ F @ left = 0``.

    Args:
        fundamental: float64 (3, 3).
        left_px: float64 (N, 2), pixels of the left picture.
        right_px: float64 (N, 2), pixels of the right picture.
        size: (width, height) of the pictures.
    """
    in_left = [_line(fundamental.T @ [*pixel, 1.0], size) for pixel in right_px]
    in_right = [_line(fundamental @ [*pixel, 1.0], size) for pixel in left_px]
    return in_left, in_right


def _curve(
    seen_by: CameraIntrinsics, other: CameraIntrinsics, T: Float64, pixel: Float64, unit_m: float
) -> Float64:
    ray = unproject(seen_by, pixel[None])
    return project_into_picture(other, apply(T, ray * _DEPTHS[:, None] * unit_m))


def _line(line: Float64, size: tuple[int, int]) -> Float64:
    """float64 (M, 2), points of a line a·x + b·y + c = 0 within a picture."""
    a, b, c = line
    if abs(b) >= abs(a):
        x = np.linspace(0, size[0] - 1, 50)
        points = np.stack([x, -(a * x + c) / b], axis=1)
    else:
        y = np.linspace(0, size[1] - 1, 50)
        points = np.stack([-(b * y + c) / a, y], axis=1)
    outside = ((points < 0) | (points > (size[0] - 1, size[1] - 1))).any(axis=1)
    points[outside] = np.nan
    return points
