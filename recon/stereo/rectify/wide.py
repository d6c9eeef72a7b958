"""Rectified views of wide-angle cameras, whose field of view does not fit on an image plane."""

from __future__ import annotations

import math
from typing import Final

import cv2
import numpy as np

from recon.core.values import CameraIntrinsics, StereoCalibration
from recon.core.values.arrays import Float64
from recon.stereo.rectify.lens import rays_of

# A planar image stretches by 1 / cos²: fourfold at 60 degrees from the optical axis.
_WIDEST: Final = math.tan(math.radians(60))
_BORDER_POINTS: Final = 65

Box = tuple[Float64, Float64]


def plan_wide_view(
    calibration: StereoCalibration, alpha: float | None
) -> tuple[Float64, Float64, Float64, Float64]:
    """Return rotations and projections of the rectified views, like ``stereoRectify`` for pinholes.

    The centre of the views keeps the resolution of the lens, so they show less than a wide lens
    sees; along their shorter side they reach at most 60 degrees from the optical axis.

    Returns:
        ``R_left, R_right`` (3, 3) and ``P_left, P_right`` (3, 4).

    Ref: Bouguet's rotations; the scale between inner and outer rectangle as OpenCV's ``alpha``.
    """
    left, right = calibration.left, calibration.right
    size = (left.width_px, left.height_px)
    R_left, R_right, P_left, P_right, *_ = cv2.stereoRectify(
        left.matrix,
        None,
        right.matrix,
        None,
        size,
        calibration.T_right_left[:3, :3],
        calibration.T_right_left[:3, 3:],
        alpha=-1,
    )
    boxes = [_boxes(left, R_left), _boxes(right, R_right)]
    inner, outer = (_common([pair[kind] for pair in boxes]) for kind in (0, 1))
    focal = _focal(inner, outer, size, alpha, float(left.matrix[0, 0]))
    x, y = _middle(inner)
    for P in (P_left, P_right):
        P[0, 0] = P[1, 1] = focal
        P[0, 2] = (size[0] - 1) / 2 - focal * x
        P[1, 2] = (size[1] - 1) / 2 - focal * y
    P_right[0, 3] = -focal * calibration.baseline_m
    return R_left, R_right, P_left, P_right


def _boxes(camera: CameraIntrinsics, rotation: Float64) -> tuple[Box, Box]:
    """Return the largest box inside the rotated image border, and the smallest box around it."""
    w, h = camera.width_px - 1.0, camera.height_px - 1.0
    t, zero = np.linspace(0, 1, _BORDER_POINTS), np.zeros(_BORDER_POINTS)
    sides = {
        "left": (zero, h * t), "right": (zero + w, h * t),
        "top": (w * t, zero), "bottom": (w * t, zero + h),
    }  # fmt: skip
    flat = {name: _flat(camera, rotation, np.stack(xy, axis=1)) for name, xy in sides.items()}
    inner = (
        np.array([flat["left"][:, 0].max(), flat["top"][:, 1].max()]),
        np.array([flat["right"][:, 0].min(), flat["bottom"][:, 1].min()]),
    )
    every = np.concatenate(list(flat.values()))
    return inner, (every.min(axis=0), every.max(axis=0))


def _flat(camera: CameraIntrinsics, rotation: Float64, pixels: Float64) -> Float64:
    """Return border pixels on the plane z = 1 of the view, clipped to the widest angle."""
    plane = rays_of(camera, pixels)
    # Rays at 90 degrees or more do not meet z = 1: they are placed at the clipping limit.
    centre = np.array([camera.matrix[0, 2], camera.matrix[1, 2]])
    outward = np.concatenate([(pixels - centre) * 1e3, np.ones((len(pixels), 1))], axis=1)
    turned = np.where(np.isfinite(plane), plane, outward) @ rotation.T
    z = np.maximum(turned[:, 2:], 1e-3)
    return np.asarray(np.clip(turned[:, :2] / z, -_WIDEST, _WIDEST))


def _common(boxes: list[Box]) -> Box:
    low, high = zip(*boxes, strict=True)
    return np.max(low, axis=0), np.min(high, axis=0)


def _middle(box: Box) -> Float64:
    return np.asarray((box[0] + box[1]) / 2)


def _focal(
    inner: Box, outer: Box, size: tuple[int, int], alpha: float | None, raw_px: float
) -> float:
    if alpha is None:
        return raw_px
    pixels = np.array(size) - 1.0
    zoomed = max(raw_px, float((pixels / np.maximum(inner[1] - inner[0], 1e-6)).max()))
    whole = float((pixels / np.maximum(outer[1] - outer[0], 1e-6)).min())
    return zoomed * (1 - alpha) + whole * alpha
