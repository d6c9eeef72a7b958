"""Camera models: raw cameras with lens distortion, and rectified stereo cameras.

What the latter see of points: pixels, disparity, depth and its error.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, replace
from os import PathLike
from typing import Any, Final, Literal

import numpy as np
from numpy.typing import NDArray

from recon.core.errors import CalibrationError
from recon.core.values.arrays import Float32, Float64, freeze

LensModel = Literal["pinhole", "fisheye", "ds", "eucm", "fov", "omni"]
#: Names of the coefficients of each lens model, in their order.
LENS_COEFFICIENTS: Final[dict[LensModel, tuple[str, ...]]] = {
    "pinhole": (
        "k1", "k2", "p1", "p2", "k3", "k4", "k5", "k6", "s1", "s2", "s3", "s4", "tx", "ty",
    ),
    "fisheye": ("k1", "k2", "k3", "k4"),
    "ds": ("xi", "alpha"),
    "eucm": ("alpha", "beta"),
    "fov": ("w",),
    "omni": ("xi", "k1", "k2", "p1", "p2"),
}  # fmt: skip
PINHOLE_COUNTS: Final = (0, 4, 5, 8, 12, 14)  # of coefficients that OpenCV supports
_WITHIN: Final[dict[LensModel, tuple[tuple[float, float], ...]]] = {  # of the first coefficients
    "ds": ((-1.0, 1.0), (0.0, 1.0)),
    "eucm": ((0.0, 1.0), (1e-3, 1e3)),
    "fov": ((0.0, 3.1),),
    "omni": ((0.0, 100.0),),
}

#: Of a principal point from the image centre, in image sizes, by which a calibration may still be
#: of these images: at half the calibrated size it is 0.5.
LARGEST_CENTRE_OFFSET: Final = 0.25
_FOCAL_SIZES: Final = (0.01, 1000.0)  # focal lengths in image sizes: to see 179 and 0.06 degrees
_MOST_SIZES: Final = 100.0  # of a principal point from the centre, in image sizes: no crop has it
_LARGEST_PX: Final = 1_000_000
_BASELINE_M: Final = (1e-6, 1e4)  # shorter and longer than any, also in other units than metres
_MOST_DISTORTION: Final = 1e6  # larger than any; coefficients of the rational model reach hundreds


@dataclass(frozen=True, eq=False)
class CameraIntrinsics:
    """A raw camera: its matrix and lens distortion.

    Attributes:
        matrix: float64 (3, 3), the camera matrix in pixels; pixel centres are at integers.
        distortion: float64 (N,). Pinhole: OpenCV's order (k1 k2 p1 p2 k3 …), empty = none;
            the others: all of `LENS_COEFFICIENTS`.
        model: ``pinhole`` projects by the tangent of the angle to the optical axis, ``fisheye``
            by the angle itself (also called equidistant, or Kannala-Brandt), ``ds`` by two spheres,
            ``eucm`` by an ellipsoid, ``fov`` by its angle w, ``omni`` by a mirror (Mei).
    """

    matrix: Float64
    distortion: Float64
    width_px: int
    height_px: int
    model: LensModel = "pinhole"

    def __post_init__(self) -> None:
        freeze(self, "matrix", np.float64, (3, 3))
        freeze(self, "distortion", np.float64, (None,))
        if not (np.isfinite(self.matrix).all() and np.isfinite(self.distortion).all()):
            raise CalibrationError("camera matrix or distortion is not finite")
        (fx, skew, cx), (zero, fy, cy), last = self.matrix.tolist()
        _check_view((fx, fy), (cx, cy), (self.width_px, self.height_px))
        if abs(skew) > fx or zero != 0 or last != [0, 0, 1]:
            raise CalibrationError("camera matrix is not that of a lens", got=self.matrix.tolist())
        if np.abs(self.distortion).max(initial=0.0) > _MOST_DISTORTION:
            raise CalibrationError("distortion is implausible", got=self.distortion.tolist())
        names = LENS_COEFFICIENTS[self.model]
        if self.model == "pinhole" and self.distortion.size not in PINHOLE_COUNTS:
            what, expected = "distortion has the wrong size", "4, 5, 8, 12 or 14 coefficients"
            raise CalibrationError(what, got=self.distortion.size, expected=expected)
        if self.model != "pinhole" and self.distortion.size != len(names):
            what = f"the lens model {self.model} has other coefficients"
            raise CalibrationError(what, got=self.distortion.size, expected=" ".join(names))
        limits = _WITHIN.get(self.model, ())
        for name, value, (least, most) in zip(names, self.distortion, limits, strict=False):
            if not least <= value <= most:
                what = f"{name} of the lens model {self.model} is implausible"
                raise CalibrationError(what, got=f"{value:g}", expected=f"{least:g} to {most:g}")

    def __repr__(self) -> str:
        (fx, _, cx), (_, fy, cy), _ = self.matrix.tolist()
        lens = ", ".join(f"{k:.4g}" for k in self.distortion)
        return (
            f"CameraIntrinsics({self.width_px}x{self.height_px}, fx {fx:.6g}, fy {fy:.6g}, "
            f"cx {cx:.6g}, cy {cy:.6g} px, {self.model} [{lens}])"
        )


@dataclass(frozen=True, eq=False)
class StereoCalibration:
    """Two raw cameras and their relative pose.

    ``T_right_left`` is float64 (4, 4), metres (OpenCV's ``R`` and ``T``):
    ``xyz_right = apply(T_right_left, xyz_left)``.
    """

    left: CameraIntrinsics
    right: CameraIntrinsics
    T_right_left: Float64

    def __post_init__(self) -> None:
        freeze(self, "T_right_left", np.float64, (4, 4))
        rotation = self.T_right_left[:3, :3]
        if not np.isfinite(self.T_right_left).all():
            raise CalibrationError("pose of the right camera is not finite")
        check_rotation(rotation, "R of the right camera")
        _check_baseline(self.baseline_m)

    def __repr__(self) -> str:
        return f"StereoCalibration(baseline {self.baseline_m:.6g} m, {self.left}, {self.right})"

    @property
    def baseline_m(self) -> float:
        """Distance between the two camera centres."""
        return float(np.linalg.norm(self.T_right_left[:3, 3]))


@dataclass(frozen=True)
class RectifiedCamera:
    """A rectified stereo camera: rows aligned, one focal length, x axes along the baseline.

    Attributes:
        cx_px: Column of the principal point of the left view; that of the right is ``cx_right_px``.
        cy_px: Row of the principal point of both views.
        ndisp: Number of disparities to search, as given by the calibration file, or None.
    """

    focal_px: float
    cx_px: float
    cy_px: float
    cx_right_px: float
    baseline_m: float
    width_px: int
    height_px: int
    ndisp: int | None = None

    def __post_init__(self) -> None:
        numbers = (self.focal_px, self.cx_px, self.cy_px, self.cx_right_px, self.baseline_m)
        if not all(math.isfinite(number) for number in numbers):
            raise CalibrationError("calibration holds a number that is not finite", got=numbers)
        size_px, focal_px = (self.width_px, self.height_px), (self.focal_px, self.focal_px)
        for cx_px in (self.cx_px, self.cx_right_px):
            _check_view(focal_px, (cx_px, self.cy_px), size_px)
        _check_baseline(self.baseline_m)

    @classmethod
    def from_matrices(
        cls, left: Float64, right: Float64, baseline_m: float, width_px: int, height_px: int
    ) -> RectifiedCamera:
        """Return the camera of the pinhole matrices, (3, 3) or (3, 4), of both views."""
        f, cx, cy, cx_right = map(float, (left[0, 0], left[0, 2], left[1, 2], right[0, 2]))
        return cls(f, cx, cy, cx_right, float(baseline_m), width_px, height_px)

    @property
    def doffs_px(self) -> float:
        """``cx_right - cx_left``: the disparity of a point at infinity, negated."""
        return self.cx_right_px - self.cx_px

    @property
    def field_of_view_deg(self) -> float:
        """Horizontal field of view of the left view."""
        left = math.atan((self.cx_px + 0.5) / self.focal_px)
        return math.degrees(left + math.atan((self.width_px - 0.5 - self.cx_px) / self.focal_px))

    @property
    def matrix(self) -> Float64:
        """float64 (3, 3) pinhole matrix of the left view."""
        f, cx, cy = self.focal_px, self.cx_px, self.cy_px
        return np.array([[f, 0.0, cx], [0.0, f, cy], [0.0, 0.0, 1.0]])

    @property
    def right_matrix(self) -> Float64:
        matrix = self.matrix
        matrix[0, 2] = self.cx_right_px
        return matrix

    def resized(self, width_px: int, height_px: int) -> RectifiedCamera:
        """Return the camera of the same view at another image size; the baseline does not change.

        Pixel centres are at integers, so a principal point scales as ``(c + 0.5)·s - 0.5``.
        Middlebury multiplies ``c`` and ``doffs`` by ``s``: up to half a pixel off for ``c``.
        """
        s = width_px / self.width_px
        return replace(
            self,
            focal_px=self.focal_px * s,
            cx_px=(self.cx_px + 0.5) * s - 0.5,
            cy_px=(self.cy_px + 0.5) * height_px / self.height_px - 0.5,
            cx_right_px=(self.cx_right_px + 0.5) * s - 0.5,
            width_px=width_px,
            height_px=height_px,
            ndisp=None if self.ndisp is None else math.ceil(self.ndisp * s),
        )


def _check_view(
    focal_px: tuple[float, float], centre_px: tuple[float, float], size_px: tuple[int, int]
) -> None:
    size = f"{size_px[0]}x{size_px[1]}"
    if min(size_px) < 1:
        raise CalibrationError("image size is empty", got=size)
    if max(size_px) > _LARGEST_PX:
        raise CalibrationError("image size is implausible", got=size)
    for f, c, n in zip(focal_px, centre_px, size_px, strict=True):
        if f <= 0:
            raise CalibrationError("focal length is not positive", got=f"{f:g} px")
        if not _FOCAL_SIZES[0] * min(size_px) <= f <= _FOCAL_SIZES[1] * max(size_px):
            got = f"{f:g} px for images of {size} pixels"
            raise CalibrationError("focal length is implausible", got=got)
        if abs(c / n - 0.5) > _MOST_SIZES:
            got = f"at {c:g} of {n} pixels"
            raise CalibrationError("principal point is far outside of the image", got=got)


def check_rotation(rotation: Float64, name: str) -> None:
    """Check that a matrix (3, 3) of a calibration is a rotation."""
    # 1e-3: calibration files often print no more than six digits.
    orthonormal = np.allclose(rotation @ rotation.T, np.eye(3), atol=1e-3)
    if not orthonormal or np.linalg.det(rotation) < 0:
        raise CalibrationError(
            f"{name} is not a rotation",
            got=rotation.round(4).tolist() if rotation.any() else "zeros",
            hint="take it from a calibration of both cameras as a pair",
        )


def check_side_by_side(step_m: Float64, where: str | PathLike[str] | None = None) -> None:
    """Check that the right camera is to the right; ``step_m`` (3,) is its ``T``."""
    x, y, z = step_m.tolist()
    if -x > max(abs(y), abs(z)) or not step_m.any():  # a baseline of zero has an error of its own
        return
    what = "cameras are not side by side"
    hint = "rotate the images of a vertical rig by 90 degrees and calibrate again"
    if x > max(abs(y), abs(z)):
        what = "right camera is to the left of the left camera"
        hint = "swap left and right, of images and calibration"
    elif abs(z) > abs(y):
        hint = "one is behind the other: check T, whose axes are x right, y down, z forward"
    got, expected = f"right camera at ({0.0 - x:g}, {0.0 - y:g}, {0.0 - z:g}) m", "mostly along x"
    raise CalibrationError(what, where=where, got=got, expected=expected, hint=hint)


def _check_baseline(baseline_m: float) -> None:
    if baseline_m <= 0:
        what, hint = "baseline is negative", "check that left and right are not swapped"
        if baseline_m == 0:
            what, hint = "baseline is zero", "calibrate both cameras as a pair"
        raise CalibrationError(what, got=f"{baseline_m:g} m", expected="> 0 m", hint=hint)
    if not _BASELINE_M[0] <= baseline_m <= _BASELINE_M[1]:
        raise CalibrationError("baseline is implausible", got=f"{baseline_m:g} m")


# Calibration of a pair of cameras: of rectified images, or of raw ones.
Rig = RectifiedCamera | StereoCalibration


def check_size(
    calibration: Rig, width_px: int, height_px: int, where: str | PathLike[str] | None
) -> None:
    """Check that images have the size of their calibration; every use of a calibration does."""
    camera = calibration if isinstance(calibration, RectifiedCamera) else calibration.left
    if (width_px, height_px) != (camera.width_px, camera.height_px):
        raise other_size(width_px, height_px, f"{camera.width_px}x{camera.height_px}", where)


def other_size(
    width_px: int, height_px: int, expected: str, where: str | PathLike[str] | None
) -> CalibrationError:
    """Return the error for images of another size than their calibration."""
    return CalibrationError(
        "images have another size than the calibration",
        where=where,
        got=f"{width_px}x{height_px}",
        expected=expected,
        hint="use images as they were calibrated (not resized, cropped or rotated), or a "
        "calibration of these images",
    )


def check_unsized(
    centre_px: tuple[float, float], width_px: int, height_px: int, where: str | PathLike[str]
) -> None:
    """Check a calibration from a file that does not state its image size against the images."""
    offsets = (centre_px[0] / width_px - 0.5, centre_px[1] / height_px - 0.5)
    if max(map(abs, offsets)) > LARGEST_CENTRE_OFFSET:
        raise CalibrationError(
            "the calibration is of another size",
            where=where,
            got=f"principal point at ({centre_px[0]:g}, {centre_px[1]:g}) of "
            f"{width_px}x{height_px} pixels",
            expected="near the centre",
            hint="use images as they were calibrated; a cropped image needs a calibration file "
            "that stores the size",
        )


def unproject(
    u: NDArray[Any], v: NDArray[Any], depth_m: NDArray[Any], camera: RectifiedCamera
) -> NDArray[Any]:
    """Return points (N, 3), camera axes, of pixels (N,) of known depth along the optical axis."""
    x = (u - camera.cx_px) * depth_m / camera.focal_px
    y = (v - camera.cy_px) * depth_m / camera.focal_px
    return np.stack([x, y, depth_m], axis=-1).astype(depth_m.dtype)


def project(
    xyz: NDArray[Any], camera: RectifiedCamera
) -> tuple[NDArray[Any], NDArray[Any], NDArray[Any]]:
    """Return columns, rows and disparity (N,) of points (N, 3), camera axes; behind it NaN."""
    z = np.where(xyz[:, 2] > 0, xyz[:, 2], np.nan)
    u = camera.focal_px * xyz[:, 0] / z + camera.cx_px
    v = camera.focal_px * xyz[:, 1] / z + camera.cy_px
    d = camera.focal_px * camera.baseline_m / z - camera.doffs_px
    return u, v, d


def depth_from_disparity(disparity_px: NDArray[Any], camera: RectifiedCamera) -> Float32:
    """Return ``Z = f·b / (d + doffs)``, float32; NaN where d is NaN or Z is not in front."""
    shifted = np.asarray(disparity_px, dtype=np.float64) + camera.doffs_px
    # A depth that overflows float32 is infinite.
    with np.errstate(divide="ignore", invalid="ignore", over="ignore"):
        depth = camera.focal_px * camera.baseline_m / shifted
        return np.where(shifted > 0, depth, np.nan).astype(np.float32)


def disparity_from_depth(depth_m: NDArray[Any], camera: RectifiedCamera) -> Float32:
    """Return the disparity of a depth; NaN where the depth is unknown or not positive."""
    depth = np.asarray(depth_m, dtype=np.float64)
    with np.errstate(divide="ignore", invalid="ignore"):
        disparity = camera.focal_px * camera.baseline_m / depth - camera.doffs_px
    return np.where(depth > 0, disparity, np.nan).astype(np.float32)


def depth_sigma(
    depth_m: NDArray[Any], sigma_px: NDArray[Any] | float, camera: RectifiedCamera
) -> Float32:
    """Return the standard deviation of the depth, to first order: ``Z²·sigma_d / (f·b)``."""
    fb = camera.focal_px * camera.baseline_m
    sigma = np.asarray(depth_m, dtype=np.float64) ** 2 * sigma_px / fb
    return np.asarray(sigma, dtype=np.float32)
