"""Calibrated rectification: warp both images so that matching pixels lie on the same row."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Final, Literal

import cv2
import numpy as np
from pydantic import Field

from recon.core.errors import CalibrationError, ShapeError
from recon.core.geometry.se3 import angle_rad
from recon.core.settings import Settings
from recon.core.values import (
    CameraIntrinsics,
    Recorded,
    RectifiedCamera,
    RectifiedPair,
    Rig,
    StereoCalibration,
    StereoPair,
    check_side_by_side,
    check_size,
)
from recon.core.values.arrays import Bool, Float32, Float64, UInt8, frozen_array
from recon.stereo.match.search import GRADIENT_CAP
from recon.stereo.rectify.lens import (
    border_of,
    central_focal_px,
    rays_of,
    rectifying_maps,
    sees_all,
)

# Allows for rounding in identity maps; far below the resolution of the interpolation (1/32 px).
_BORDER_TOLERANCE_PX: Final = 1e-3
# At larger angles the views of two pinhole cameras hardly overlap.
_LARGEST_ANGLE_RAD: Final = math.radians(60)
# Focal lengths of raw and rectified views differ by a factor of two or three at most.
_OUT_OF_PROPORTION: Final = 20.0


class RectificationSettings(Settings):
    """Rectification of raw images."""

    alpha: float | None = Field(0.0, ge=0, le=1)
    """Zoom of the rectified views: 0 = only valid pixels, 1 = all source pixels, none = OpenCV's
    default. Raise it where the borders matter. No effect on rectified input."""
    field_of_view_deg: float | None = Field(None, ge=10, le=150)
    """Horizontal field of view of the rectified views, in place of alpha. none = by alpha; 0 of a
    fisheye keeps the resolution at its centre, at most 120 degrees."""


@dataclass(frozen=True, eq=False)
class RemapTables:
    """Remap tables of one rectified view."""

    map_x: Float32  # (H, W), source columns in the raw image
    map_y: Float32  # (H, W), source rows in the raw image

    @property
    def inside(self) -> Bool:
        """bool (H, W), True where the source is inside the raw image."""
        height, width = self.map_x.shape
        x, y, e = self.map_x, self.map_y, _BORDER_TOLERANCE_PX
        return np.asarray((x >= -e) & (y >= -e) & (x <= width - 1 + e) & (y <= height - 1 + e))

    def warp(self, image: UInt8) -> UInt8:
        """Rectify one raw image; pixels without a source are black."""
        return np.asarray(cv2.remap(image, self.map_x, self.map_y, cv2.INTER_LINEAR))


class Rectifier:
    """Rectifies the pairs of a rig; those of a rectified camera are only checked and made grey."""

    def __init__(self, calibration: Rig, settings: RectificationSettings | None = None) -> None:
        self.settings = settings or RectificationSettings()
        #: bool (H, W), where the rectified left view has a source; None = everywhere.
        self.valid: Bool | None = None
        self._views: tuple[RemapTables, RemapTables] | None = None
        if isinstance(calibration, RectifiedCamera):
            self.camera = calibration
            return
        turns = plan_turns(calibration, self.settings)
        self.camera = turns.camera
        self._views = _remap_tables(calibration, turns)
        self.valid = self._views[0].inside
        self.valid.flags.writeable = False
        if not (self.valid.any() and self._views[1].inside.any()):
            raise CalibrationError(
                "no pixel of the rectified views has a source",
                hint="check the distortion and the pose of the right camera",
            )

    def rectify(self, pair: Recorded) -> RectifiedPair:
        left, right = self.warp(pair)
        greys = quieted(to_grey(left), to_grey(right))
        return RectifiedPair(
            *greys,
            camera=self.camera,
            left_rgb=left if left.ndim == 3 else None,
            right_rgb=right if right.ndim == 3 else None,
            valid=self.valid,
            timestamp_s=pair.timestamp_s,
            index=pair.index,
        )

    def warp(self, pair: Recorded) -> tuple[UInt8, UInt8]:
        """Rectify both images of a pair, without grey conversion; one without two is refused."""
        if not isinstance(pair, StereoPair):
            raise ShapeError("there is no right image", where=f"frame {pair.index}")
        height_px, width_px = pair.left.shape[:2]
        check_size(self.camera, width_px, height_px, pair.name or f"frame {pair.index}")
        if self._views is None:
            return pair.left, pair.right
        left, right = self._views
        return left.warp(pair.left), right.warp(pair.right)


@dataclass(frozen=True, eq=False)
class RectifyingTurns:
    """Rectifying rotations of the two cameras, and the rectified camera."""

    R_left: Float64  # (3, 3), from the axes of the raw left camera to the rectified axes
    R_right: Float64  # the same for the right camera
    camera: RectifiedCamera  # geometry of the rectified views

    @property
    def matrices(self) -> tuple[Float64, Float64]:
        """float64 (3, 3) pinhole matrices of the left and the right view."""
        return self.camera.matrix, self.camera.right_matrix

    def place(
        self, calibration: StereoCalibration, pixels: Float64, *, right: bool = False
    ) -> Float64:
        """Return rectified positions, float64 (N, 2), of raw pixels of one camera; NaN = none."""
        camera = calibration.right if right else calibration.left
        rays = rays_of(camera, pixels) @ (self.R_right if right else self.R_left).T
        flat = (rays / rays[:, 2:]) @ self.matrices[int(right)].T
        return np.asarray(np.where(rays[:, 2:] > 0, flat[:, :2], np.nan))


def plan_turns(calibration: StereoCalibration, settings: RectificationSettings) -> RectifyingTurns:
    """Compute the rectifying rotations of a rig and the rectified camera, by Bouguet's method."""
    _check_rig(calibration)
    left, right = calibration.left, calibration.right
    size = (left.width_px, left.height_px)
    try:
        flat = {left.model, right.model} == {"pinhole"}
        if not (flat and sees_all(left) and sees_all(right)):
            R1, R2, P1, P2 = plan_wide_view(calibration, settings.alpha)
        else:
            alpha = -1 if settings.alpha is None else settings.alpha
            R1, R2, P1, P2 = _bouguet(calibration, left.distortion, right.distortion, alpha)
    except cv2.error as error:
        raise CalibrationError("cameras cannot be rectified", got=error.err) from error
    camera = RectifiedCamera.from_matrices(P1, P2, -P2[0, 3] / P2[0, 0], *size)
    _check_focal(camera, left)
    return RectifyingTurns(R1, R2, _with_field(camera, settings.field_of_view_deg))


def turns_of(rig: Rig, settings: RectificationSettings) -> RectifyingTurns:
    """Return the rectifying rotations of any rig; none of one that is rectified."""
    if isinstance(rig, StereoCalibration):
        return plan_turns(rig, settings)
    return RectifyingTurns(np.eye(3), np.eye(3), rig)


def _remap_tables(
    calibration: StereoCalibration, turns: RectifyingTurns
) -> tuple[RemapTables, RemapTables]:
    size = (turns.camera.width_px, turns.camera.height_px)
    cameras, rotations = (calibration.left, calibration.right), (turns.R_left, turns.R_right)
    try:
        left, right = (
            RemapTables(*rectifying_maps(camera, rotation, matrix, size))
            for camera, rotation, matrix in zip(cameras, rotations, turns.matrices, strict=True)
        )
    except cv2.error as error:
        raise CalibrationError("cameras cannot be rectified", got=error.err) from error
    return left, right


def _bouguet(
    calibration: StereoCalibration, left: Float64 | None, right: Float64 | None, alpha: float
) -> Sequence[Float64]:
    """Return R_left, R_right (3, 3) and P_left, P_right (3, 4), for the distortions given."""
    cameras, T = (calibration.left, calibration.right), calibration.T_right_left
    size = (cameras[0].width_px, cameras[0].height_px)
    K_left, K_right = (camera.matrix for camera in cameras)
    R, t = T[:3, :3], T[:3, 3:]
    return cv2.stereoRectify(K_left, left, K_right, right, size, R, t, alpha=alpha)[:4]


def _with_field(camera: RectifiedCamera, field_of_view_deg: float | None) -> RectifiedCamera:
    """Zoom about the image centre to a horizontal field of view; None = unchanged."""
    if field_of_view_deg is None:
        return camera
    x, y = (camera.width_px - 1) / 2, (camera.height_px - 1) / 2
    zoom = camera.width_px / 2 / math.tan(math.radians(field_of_view_deg / 2)) / camera.focal_px
    return replace(
        camera,
        focal_px=camera.focal_px * zoom,
        cx_px=x + (camera.cx_px - x) * zoom,
        cy_px=y + (camera.cy_px - y) * zoom,
        cx_right_px=x + (camera.cx_right_px - x) * zoom,
    )


def _check_focal(camera: RectifiedCamera, raw: CameraIntrinsics) -> None:
    usual_px = central_focal_px(raw)
    ratio = camera.focal_px / usual_px
    if not 1 / _OUT_OF_PROPORTION < ratio < _OUT_OF_PROPORTION:
        raise CalibrationError(
            "the rectified views came out with a focal length out of all proportion",
            got=f"{camera.focal_px:.4g} px",
            expected=f"about {usual_px:.4g} px as in the raw images",
            hint="check the distortion coefficients; if they are right, this is an error of recon: "
            "please report it with the calibration",
        )


def _check_rig(calibration: StereoCalibration) -> None:
    left, right = calibration.left, calibration.right
    if (left.width_px, left.height_px) != (right.width_px, right.height_px):
        raise CalibrationError(
            "left and right camera differ in image size",
            got=f"left {left.width_px}x{left.height_px}, right {right.width_px}x{right.height_px}",
        )
    check_side_by_side(calibration.T_right_left[:3, 3])
    apart_rad = float(angle_rad(calibration.T_right_left))
    if apart_rad > _LARGEST_ANGLE_RAD:
        raise CalibrationError(
            "cameras look in different directions",
            got=f"{math.degrees(apart_rad):.0f} deg",
            expected=f"at most {math.degrees(_LARGEST_ANGLE_RAD):.0f} deg",
        )


# A planar image stretches by 1 / cos²: fourfold at 60 degrees from the optical axis.
_WIDEST: Final = math.tan(math.radians(60))

Box = tuple[Float64, Float64]


def plan_wide_view(calibration: StereoCalibration, alpha: float | None) -> Sequence[Float64]:
    """Return R_left, R_right, P_left, P_right of wide views, as ``stereoRectify`` of pinholes.

    The centre of the views keeps the resolution of the lens, so they show less than a wide lens
    sees; along their shorter side they reach at most 60 degrees from the optical axis.

    Ref: Bouguet's rotations; the scale between inner and outer rectangle as OpenCV's ``alpha``.
    """
    left, right = calibration.left, calibration.right
    size = (left.width_px, left.height_px)
    R_left, R_right, P_left, P_right = _bouguet(calibration, None, None, -1)
    boxes = np.array([_boxes(left, R_left), _boxes(right, R_right)])
    inner, outer = zip(boxes[:, :, 0].max(axis=0), boxes[:, :, 1].min(axis=0), strict=True)
    focal = raw_px = central_focal_px(left)
    if alpha is not None:
        pixels = np.array(size) - 1.0
        zoomed = max(raw_px, float((pixels / np.maximum(inner[1] - inner[0], 1e-6)).max()))
        whole = float((pixels / np.maximum(outer[1] - outer[0], 1e-6)).min())
        focal = zoomed * (1 - alpha) + whole * alpha
    x, y = (inner[0] + inner[1]) / 2
    for P in (P_left, P_right):
        P[0, 0] = P[1, 1] = focal
        P[0, 2] = (size[0] - 1) / 2 - focal * x
        P[1, 2] = (size[1] - 1) / 2 - focal * y
    P_right[0, 3] = -focal * calibration.baseline_m
    return R_left, R_right, P_left, P_right


def _boxes(camera: CameraIntrinsics, rotation: Float64) -> tuple[Box, Box]:
    """Return the largest box inside the rotated image border, and the smallest box around it."""
    sides = [_flat(camera, rotation, side) for side in border_of(camera)]
    left, right, top, bottom = sides
    inner = (
        np.array([left[:, 0].max(), top[:, 1].max()]),
        np.array([right[:, 0].min(), bottom[:, 1].min()]),
    )
    every = np.concatenate(sides)
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


GreyMode = Literal["bt601", "mean", "paper"]

_PAPER_WEIGHTS: Final = np.array([0.299, 0.587, 0.144])


def to_grey(image: UInt8, mode: GreyMode = "bt601") -> UInt8:
    """Convert an image, uint8 (H, W, 3) RGB, to grey; a grey image is returned unchanged.

    ``bt601`` weights red, green and blue by 0.299, 0.587 and 0.114, ``mean`` equally. ``paper`` is
    Eq. 6 of the seed paper as printed: its weight of blue, 0.144, is a misprint of 0.114, so the
    weights sum to 1.03 and bright pixels are clipped at 255.

    Ref: ITU-R BT.601, section 2.5.1.
    """
    if isinstance(image, np.ndarray) and image.ndim == 2:
        return frozen_array("image", image, np.uint8, (None, None))
    frozen_array("image", image, np.uint8, (None, None, 3))
    if mode == "bt601":
        return np.asarray(cv2.cvtColor(image, cv2.COLOR_RGB2GRAY))
    if mode == "mean":
        # An integer is never halfway between two multiples of 3, so + 1 rounds to nearest.
        return np.asarray((image.sum(axis=2, dtype=np.uint16) + 1) // 3, dtype=np.uint8)
    return np.asarray(np.clip(np.rint(image @ _PAPER_WEIGHTS), 0, 255), dtype=np.uint8)


LEAST_NOISE: Final = 0.5  # grey values: rounding alone leaves 0.3
_DROWNING: Final = GRADIENT_CAP / math.sqrt(12.0)
"""Grey values of noise of which a Sobel filter makes gradients as large as any that count."""
_SMOOTH_PX: Final = 1.0  # leaves 0.28 of white noise; more hides corners


def noise_sigma(grey: UInt8) -> float:
    """The standard deviation of the noise of an image, grey values.

    From the median of mixed fourth differences, in which gradients and straight edges cancel.

    Ref: Immerkær, "Fast noise variance estimation", CVIU 1996.
    """
    # Every fourth column and row: some ten thousand values give a median to one per cent.
    columns = [grey[:, k : k + grey.shape[1] - 2 : 4].astype(np.int16) for k in range(3)]
    across = columns[0] - 2 * columns[1] + columns[2]
    rows = [across[k : k + len(across) - 2 : 4] for k in range(3)]
    mixed = rows[0] - 2 * rows[1] + rows[2]
    if not mixed.size:
        return LEAST_NOISE
    # The weights' squares sum to 36; 0.6745 of a normal deviation is its median magnitude.
    return max(float(np.median(np.abs(mixed))) / (6.0 * 0.6745), LEAST_NOISE)


def shows_texture(image: UInt8) -> bool:
    """Return whether most of an image has more fine texture than noise.

    Halving an image takes half of the noise of its pixels, but leaves texture what it is.
    """
    grey = to_grey(image)
    small = cv2.resize(grey, None, fx=0.5, fy=0.5, interpolation=cv2.INTER_AREA)
    return noise_sigma(small) >= max(noise_sigma(grey), 2 * LEAST_NOISE)


def quieted(left: UInt8, right: UInt8) -> tuple[UInt8, UInt8]:
    """Smooth both images (H, W) where noise hides what they show, as at night."""
    if noise_sigma(left) > _DROWNING and noise_sigma(right) > _DROWNING:
        left, right = (cv2.GaussianBlur(each, (0, 0), _SMOOTH_PX) for each in (left, right))
    return left, right
