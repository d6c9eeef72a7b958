"""Raw cameras: one interface to all lens models, and the epipolar curves they make."""

from __future__ import annotations

from typing import Any, Final

import cv2
import numpy as np
from numpy.typing import NDArray

from recon.core.geometry.se3 import apply, invert
from recon.core.values import CameraIntrinsics, StereoCalibration
from recon.core.values.arrays import Float32, Float64
from recon.stereo.rectify.closed import CLOSED_FORMS, EXACT

_ORIGIN: Final = np.zeros(3)
_LARGEST_MISS_PX: Final = 0.01  # largest reprojection error of a correctly inverted ray


def project_raw(camera: CameraIntrinsics, xyz: NDArray[Any]) -> Float64:
    """Return float64 (N, 2), pixels of points (N, 3) in camera axes; NaN at or behind its plane."""
    if camera.model not in CLOSED_FORMS:
        return project_with_jacobian(camera, xyz)[0]
    points = np.asarray(xyz, dtype=np.float64).reshape(-1, 3)
    with np.errstate(all="ignore"):
        plane = CLOSED_FORMS[camera.model][0](camera.distortion, points)
    pixels = plane @ camera.matrix[:2, :2].T + camera.matrix[:2, 2]
    return np.asarray(np.where(points[:, 2:] > 0, pixels, np.nan))


def central_focal_px(camera: CameraIntrinsics) -> float:
    """Return the resolution at the optical axis, in pixels per radian along a row."""
    if camera.model not in CLOSED_FORMS:
        return float(camera.matrix[0, 0])
    at, step = np.array([[0, 0, 1.0], [1e-6, 0, 1.0]]), 1e-6
    return float(np.diff(project_raw(camera, at)[:, 0])[0] / step)


def project_with_jacobian(
    camera: CameraIntrinsics, xyz: NDArray[Any]
) -> tuple[Float64, Float64, Float64]:
    """Project points (N, 3) in camera axes to pixels (N, 2), NaN at or behind the camera's plane.

    With their Jacobians by the point, (N, 2, 3), and by (fx, fy, cx, cy, distortion …),
    (N, 2, 4 + D). Of OpenCV's lens models alone: pinhole and fisheye.
    """
    points = np.ascontiguousarray(xyz, dtype=np.float64).reshape(-1, 1, 3)
    matrix, distortion = np.array(camera.matrix), np.array(camera.distortion)
    count = distortion.size
    if camera.model == "fisheye":
        pixels, J = cv2.fisheye.projectPoints(points, _ORIGIN, _ORIGIN, matrix, distortion)
        by_point, by_lens = J[:, 11:14], J[:, :8]
    else:
        # OpenCV needs at least four distortion coefficients.
        padded = distortion if count else np.zeros(4)
        pixels, J = cv2.projectPoints(points, _ORIGIN, _ORIGIN, matrix, padded)
        by_point, by_lens = J[:, 3:6], J[:, 6 : 10 + count]
    pixels = pixels.reshape(-1, 2)
    pixels[points[:, 0, 2] <= 0] = np.nan
    return pixels, by_point.reshape(-1, 2, 3), by_lens.reshape(len(pixels), 2, -1)


def project_into_image(camera: CameraIntrinsics, xyz: NDArray[Any]) -> Float64:
    """Return float64 (N, 2), pixels of points (N, 3) inside the image; NaN for all others.

    Far outside the field of view the distortion polynomial may fold points back into the image: the
    ray of such a pixel does not lead to the point.
    """
    pixels = project_raw(camera, xyz)
    limit = np.array([camera.width_px - 1, camera.height_px - 1])
    inside = np.asarray(((pixels >= 0) & (pixels <= limit)).all(axis=1))
    with np.errstate(invalid="ignore", divide="ignore"):
        apart = np.abs(rays_of(camera, np.where(inside[:, None], pixels, 0.0)) * xyz[:, 2:] - xyz)
        true = np.asarray((apart < 1e-3 * np.abs(xyz[:, 2:])).all(axis=1))
    return np.where((inside & true)[:, None], pixels, np.nan)


def rays_of(camera: CameraIntrinsics, pixels: NDArray[Any]) -> Float64:
    """Return float64 (N, 3), the rays of pixels (N, 2) in camera axes, with z = 1.

    NaN where the lens model cannot be inverted, or at 90 degrees or more from the optical axis.
    """
    points = np.ascontiguousarray(pixels, dtype=np.float64).reshape(-1, 1, 2)
    matrix, distortion = np.array(camera.matrix), np.array(camera.distortion)
    if not len(points):
        return np.zeros((0, 3))
    if camera.model in CLOSED_FORMS:
        plane = (points[:, 0] - matrix[:2, 2]) @ np.linalg.inv(matrix[:2, :2]).T
        with np.errstate(all="ignore"):
            rays = CLOSED_FORMS[camera.model][1](distortion, plane)
            return np.asarray(np.where(rays[:, 2:] > 0, rays / rays[:, 2:], np.nan))
    model: Any = cv2.fisheye if camera.model == "fisheye" else cv2
    plane = model.undistortPoints(points, matrix, distortion, criteria=EXACT)
    rays = np.concatenate([plane.reshape(-1, 2), np.ones((len(points), 1))], axis=1)
    # OpenCV marks some failures of the fisheye model with -1e6; of other failures, and of rays at
    # more than 90 degrees, it returns the ray of another pixel.
    rays[~(np.abs(rays).max(axis=1) < 1e5)] = np.nan
    with np.errstate(invalid="ignore"):
        missed = np.abs(project_raw(camera, rays) - points[:, 0]).max(axis=1) > _LARGEST_MISS_PX
    rays[missed] = np.nan
    return rays


def sees_all(camera: CameraIntrinsics) -> bool:
    """Return whether the lens model, which may fold back, can be inverted along the border."""
    return bool(np.isfinite(rays_of(camera, np.concatenate(border_of(camera)))).all())


def border_of(camera: CameraIntrinsics) -> list[Float64]:
    """Return pixels (65, 2) along the left, right, upper and lower side of the image."""
    w, h = camera.width_px - 1.0, camera.height_px - 1.0
    t = np.linspace(0, 1, 65)
    sides = [(0 * t, h * t), (w + 0 * t, h * t), (w * t, 0 * t), (w * t, h + 0 * t)]
    return [np.stack(side, axis=1) for side in sides]


def rectifying_maps(
    camera: CameraIntrinsics, rotation: Float64, matrix: Float64, size: tuple[int, int]
) -> tuple[Float32, Float32]:
    """Return remap tables of a rotated pinhole view: columns and rows of the raw image, float32.

    ``rotation`` is from camera axes to those of the view, ``matrix`` (3, 3) or (3, 4) its pinhole
    matrix, ``size`` its (width, height).
    """
    if camera.model in CLOSED_FORMS or (camera.model == "pinhole" and not sees_all(camera)):
        # The lens model may end, or fold back into the image: there the tables are (-1, -1).
        x, y = np.meshgrid(np.arange(size[0]), np.arange(size[1]))
        rays = np.stack([x.ravel(), y.ravel(), np.ones(x.size)]).astype(np.float64)
        xyz = (np.linalg.inv(rotation) @ np.linalg.inv(matrix[:, :3]) @ rays).T
        pixels = np.nan_to_num(project_into_image(camera, xyz), nan=-1.0).astype(np.float32)
        return pixels[:, 0].reshape(x.shape), pixels[:, 1].reshape(x.shape)
    model: Any = cv2.fisheye if camera.model == "fisheye" else cv2
    raw, distortion, K = (np.array(a) for a in (camera.matrix, camera.distortion, matrix[:, :3]))
    maps = model.initUndistortRectifyMap(raw, distortion, rotation, K, size, cv2.CV_32FC1)
    return np.asarray(maps[0]), np.asarray(maps[1])


# Depths along a ray, in baselines: from nearer than any rig measures to practically infinity.
_DEPTHS: Final = np.geomspace(0.5, 1e4, 400)


def epipolar_curves(
    calibration: StereoCalibration, left_px: Float64, right_px: Float64
) -> tuple[list[Float64], list[Float64]]:
    """Return epipolar curves in the raw images (straight lines bent by the lenses).

    For each right pixel (N, 2) its curve (M, 2) in the left image, and for each left pixel its
    curve in the right image; NaN where a curve leaves the image.
    """
    T, near = calibration.T_right_left, calibration.baseline_m
    left, right = calibration.left, calibration.right
    in_left = [_curve(right, left, invert(T), pixel, near) for pixel in right_px]
    in_right = [_curve(left, right, T, pixel, near) for pixel in left_px]
    return in_left, in_right


def epipolar_lines(
    fundamental: Float64, left_px: Float64, right_px: Float64, size: tuple[int, int]
) -> tuple[list[Float64], list[Float64]]:
    """Return epipolar lines of undistorted pinhole cameras, as `epipolar_curves`.

    ``fundamental`` is the matrix F of ``right.T @ F @ left = 0``, ``size`` (width, height).
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
