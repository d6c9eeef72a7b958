"""Epipolar lines, and the curves that lens distortion makes of them."""

from __future__ import annotations

from typing import Final

import numpy as np

from recon.core.geometry.se3 import apply, invert
from recon.core.values import CameraIntrinsics, StereoCalibration
from recon.core.values.arrays import Float64
from recon.stereo.rectify.lens import project_into_image, rays_of

# Depths along a ray, in baselines: from nearer than any rig measures to practically infinity.
_DEPTHS: Final = np.geomspace(0.5, 1e4, 400)


def epipolar_curves(
    calibration: StereoCalibration, left_px: Float64, right_px: Float64
) -> tuple[list[Float64], list[Float64]]:
    """Return epipolar curves in the raw images (straight lines bent by the lenses).

    Args:
        calibration: The raw rig.
        left_px: float64 (N, 2), pixels of the left image.
        right_px: float64 (N, 2), pixels of the right image.

    Returns:
        For each right pixel its curve (M, 2) in the left image, and for each left pixel its curve
        in the right image; NaN where a curve leaves the image.
    """
    T, near = calibration.T_right_left, calibration.baseline_m
    left, right = calibration.left, calibration.right
    in_left = [_curve(right, left, invert(T), pixel, near) for pixel in right_px]
    in_right = [_curve(left, right, T, pixel, near) for pixel in left_px]
    return in_left, in_right


def epipolar_lines(
    fundamental: Float64, left_px: Float64, right_px: Float64, size: tuple[int, int]
) -> tuple[list[Float64], list[Float64]]:
    """Return epipolar lines of undistorted pinhole cameras; returned as by `epipolar_curves`.

    Args:
        fundamental: float64 (3, 3), the fundamental matrix, ``right.T @ F @ left = 0``.
        left_px: float64 (N, 2), pixels of the left image.
        right_px: float64 (N, 2), pixels of the right image.
        size: (width, height) of the images.
    """
    in_left = [_line(fundamental.T @ [*pixel, 1.0], size) for pixel in right_px]
    in_right = [_line(fundamental @ [*pixel, 1.0], size) for pixel in left_px]
    return in_left, in_right


def _curve(
    seen_by: CameraIntrinsics, other: CameraIntrinsics, T: Float64, pixel: Float64, unit_m: float
) -> Float64:
    ray = rays_of(seen_by, pixel[None])
    return project_into_image(other, apply(T, ray * _DEPTHS[:, None] * unit_m))


def _line(line: Float64, size: tuple[int, int]) -> Float64:
    """Return float64 (M, 2), points on the line a·x + b·y + c = 0; NaN outside the image."""
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
