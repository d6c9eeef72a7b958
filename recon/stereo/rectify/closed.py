"""Lens models in closed form, beside OpenCV's two; many of them see more than 180 degrees.

Each projects points to the plane of focal length 1, and finds the direction of a place there, of
any length; NaN where the model ends.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from typing import Final

import cv2
import numpy as np

from recon.core.values import LensModel
from recon.core.values.arrays import Bool, Float64

#: From coefficients and points (N, 3) to places (N, 2), and from those to directions (N, 3).
Lens = Callable[[Float64, Float64], Float64]
_PLAIN: Final = 1e-9  # radians: a lens of the model fov with less bends nothing
# OpenCV inverts a distortion iteratively, and stops early by default (five iterations, 0.01).
EXACT: Final = (cv2.TERM_CRITERIA_COUNT | cv2.TERM_CRITERIA_EPS, 100, 1e-13)


def _project_ds(lens: Float64, xyz: Float64) -> Float64:
    xi, alpha = lens
    w1 = (1 - alpha) / alpha if alpha > 0.5 else alpha / (1 - alpha)
    w2 = (w1 + xi) / np.sqrt(2 * w1 * xi + xi * xi + 1)
    near = np.linalg.norm(xyz, axis=1)
    z = xyz[:, 2]
    far = np.hypot(np.hypot(xyz[:, 0], xyz[:, 1]), xi * near + z)
    depth = alpha * far + (1 - alpha) * (xi * near + z)
    return _divided(xyz, depth, z > -w2 * near)


def _unproject_ds(lens: Float64, xy: Float64) -> Float64:
    xi, alpha = lens
    r2 = (xy**2).sum(axis=1)
    z = (1 - alpha**2 * r2) / (alpha * np.sqrt(1 - (2 * alpha - 1) * r2) + 1 - alpha)
    along = (z * xi + np.sqrt(z * z + (1 - xi * xi) * r2)) / (z * z + r2)
    return np.column_stack([along[:, None] * xy, along * z - xi])


def _project_eucm(lens: Float64, xyz: Float64) -> Float64:
    alpha, beta = lens
    z = xyz[:, 2]
    d = np.sqrt(beta * (xyz[:, 0] ** 2 + xyz[:, 1] ** 2) + z * z)
    w = (1 - alpha) / alpha if alpha > 0.5 else alpha / (1 - alpha)
    return _divided(xyz, alpha * d + (1 - alpha) * z, z > -w * d)


def _unproject_eucm(lens: Float64, xy: Float64) -> Float64:
    alpha, beta = lens
    r2 = (xy**2).sum(axis=1)
    below = alpha * np.sqrt(1 - (2 * alpha - 1) * beta * r2) + 1 - alpha
    return np.column_stack([xy, (1 - beta * alpha**2 * r2) / below])


def _project_fov(lens: Float64, xyz: Float64) -> Float64:
    w = max(float(lens[0]), _PLAIN)
    r, z, wide = np.hypot(xyz[:, 0], xyz[:, 1]), xyz[:, 2], 2 * np.tan(w / 2)
    scale = np.where(r > 0, np.arctan2(r * wide, z) / r, np.where(z > 0, wide / z, np.nan)) / w
    return xyz[:, :2] * scale[:, None]


def _unproject_fov(lens: Float64, xy: Float64) -> Float64:
    w = max(float(lens[0]), _PLAIN)
    angle = w * np.hypot(xy[:, 0], xy[:, 1])
    across = w * np.sinc(angle / np.pi)[:, None] * xy
    rays = np.column_stack([across, 2 * np.tan(w / 2) * np.cos(angle)])
    return np.where((angle < np.pi)[:, None], rays, np.nan)


def _project_omni(lens: Float64, xyz: Float64) -> Float64:
    xi, near = float(lens[0]), np.linalg.norm(xyz, axis=1)
    # Of a mirror with xi > 1 two directions share a place: those nearer to the axis are seen.
    ends = near / xi if xi > 1 else xi * near
    plane = _divided(xyz, xyz[:, 2] + xi * near, xyz[:, 2] > -ends)
    flat = np.column_stack([plane, np.ones(len(plane))])
    bent = cv2.projectPoints(flat, np.zeros(3), np.zeros(3), np.eye(3), lens[1:].copy())[0]
    return np.asarray(bent).reshape(-1, 2)


def _unproject_omni(lens: Float64, xy: Float64) -> Float64:
    xi = lens[0]
    plane = cv2.undistortPoints(
        xy.reshape(-1, 1, 2), np.eye(3), lens[1:].copy(), criteria=EXACT
    ).reshape(-1, 2)
    r2 = (plane**2).sum(axis=1)
    along = (xi + np.sqrt(1 + (1 - xi * xi) * r2)) / (r2 + 1)
    return np.column_stack([along[:, None] * plane, along - xi])


def _divided(xyz: Float64, by: Float64, seen: Bool) -> Float64:
    return np.where((seen & (by > 0))[:, None], xyz[:, :2] / by[:, None], np.nan)


#: Ref: ds: Usenko et al., "The Double Sphere Camera Model", 3DV 2018, eqs. 40-50; eucm: Khomutenko
#: et al., "An Enhanced Unified Camera Model", RA-L 2016; fov: Devernay and Faugeras, 2001; omni:
#: Mei and Rives, ICRA 2007.
CLOSED_FORMS: Final[Mapping[LensModel, tuple[Lens, Lens]]] = {
    "ds": (_project_ds, _unproject_ds),
    "eucm": (_project_eucm, _unproject_eucm),
    "fov": (_project_fov, _unproject_fov),
    "omni": (_project_omni, _unproject_omni),
}
