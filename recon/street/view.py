"""One camera of the rig at one pose."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from recon.core.values import RectifiedCamera
from recon.core.values.arrays import Bool, Float64


@dataclass(frozen=True, eq=False)
class View:
    """A pinhole camera in a scene.

    Attributes:
        T_scene_camera: float64 (4, 4).
        focal_px: Focal length.
        centre_px: Principal point, column and row.
        width_px: Image width.
        height_px: Image height.
    """

    T_scene_camera: Float64
    focal_px: float
    centre_px: tuple[float, float]
    width_px: int
    height_px: int

    @property
    def origin(self) -> Float64:
        """float64 (3,), the camera centre in the scene."""
        return self.T_scene_camera[:3, 3]

    def pixels(self) -> Float64:
        """Return float64 (H·W, 2), column and row of each pixel, row by row."""
        v, u = np.mgrid[0 : self.height_px, 0 : self.width_px]
        return np.stack([u.ravel(), v.ravel()], axis=1).astype(np.float64)

    def directions(self, pixels: Float64) -> Float64:
        """Rays (N, 3) through pixels (N, 2), scene axes, of unit depth along the optical axis."""
        sight = np.ones((len(pixels), 3))
        sight[:, :2] = (pixels - self.centre_px) / self.focal_px
        return np.asarray(sight @ self.T_scene_camera[:3, :3].T)

    def project(self, xyz: Float64) -> Float64:
        """Return pixels (N, 2) of points in the scene; NaN behind the camera."""
        local = (xyz - self.origin) @ self.T_scene_camera[:3, :3]
        depth = np.where(local[:, 2:] > 0, local[:, 2:], np.nan)
        return np.asarray(self.focal_px * local[:, :2] / depth + self.centre_px)

    def inside(self, pixels: Float64) -> Bool:
        """Return bool (N,), True where a position lies within the image."""
        u, v = pixels[:, 0], pixels[:, 1]
        with np.errstate(invalid="ignore"):
            in_u = (u >= -0.5) & (u < self.width_px - 0.5)
            return np.asarray(in_u & (v >= -0.5) & (v < self.height_px - 0.5))


def stereo_views(camera: RectifiedCamera, T_scene_left: Float64) -> tuple[View, View]:
    """Return the left and right view of a rig with its left camera at ``T_scene_left``."""
    T_scene_right = T_scene_left.copy()
    T_scene_right[:3, 3] += camera.baseline_m * T_scene_left[:3, 0]
    size = camera.width_px, camera.height_px
    left = View(T_scene_left, camera.focal_px, (camera.cx_px, camera.cy_px), *size)
    right = View(T_scene_right, camera.focal_px, (camera.cx_right_px, camera.cy_px), *size)
    return left, right
