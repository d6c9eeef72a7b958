"""From radiance to pixels: the view of a camera, antialiasing, tone curve, sensor."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Final

import numpy as np

from recon.core.values import RectifiedCamera
from recon.core.values.arrays import Bool, Float64, UInt8
from recon.street.materials import GAMMA
from recon.street.stage import Sample, Stage

_QUARTERS: Final = ((-0.25, -0.25), (0.25, -0.25), (-0.25, 0.25), (0.25, 0.25))
_CREASE: Final = 0.92  # cosine of the angle between normals, below which there is an edge
_EXPOSURE: Final = 0.9


def take_image(stage: Stage, view: View, smooth_edges: bool) -> Float64:
    """Render one view as float64 (H, W, 3), display values in [0, 1]."""
    size = (view.height_px, view.width_px)
    pixels = view.pixels()
    sample = stage.look(view.origin, view.directions(pixels), 1.0 / view.focal_px)
    light = _expose(sample.rgb)
    if smooth_edges:
        edge = _edges(sample, size)
        light[edge] = _four_rays(stage, view, pixels[edge])
    return np.asarray(light ** (1.0 / GAMMA)).reshape(*size, 3)


def record(
    image: Float64, *, gain: float, offset_dn: float, noise_dn: float, key: list[int]
) -> UInt8:
    """Apply a sensor model to display values (H, W, 3) in [0, 1]; ``key`` seeds the noise."""
    levels = 255.0 * gain * image + offset_dn
    if noise_dn > 0:
        levels += noise_dn * np.random.default_rng(key).standard_normal(levels.shape)
    return np.clip(np.rint(levels), 0, 255).astype(np.uint8)


def _expose(light: Float64) -> Float64:
    return np.clip(_EXPOSURE * light, 0.0, 1.0)


def _four_rays(stage: Stage, view: View, pixels: Float64) -> Float64:
    """Return the mean radiance (N, 3) over the four quarters of pixels (N, 2)."""
    quarters = (pixels[:, None, :] + np.array(_QUARTERS)).reshape(-1, 2)
    sample = stage.look(view.origin, view.directions(quarters), 0.5 / view.focal_px)
    return np.asarray(_expose(sample.rgb).reshape(-1, 4, 3).mean(axis=1))


def _edges(sample: Sample, size: tuple[int, int]) -> Bool:
    """Return bool (H·W,), pixels that differ from a neighbour in object, material or normal."""
    label = sample.label.reshape(size)
    normal = sample.normal.reshape(*size, 3)
    edge = np.zeros(size, dtype=np.bool_)
    for a, b in (
        ((slice(None), slice(1, None)), (slice(None), slice(None, -1))),
        ((slice(1, None), slice(None)), (slice(None, -1), slice(None))),
    ):
        differs = label[a] != label[b]
        differs |= (label[a] >= 0) & (np.einsum("hwx,hwx->hw", normal[a], normal[b]) < _CREASE)
        edge[a] |= differs
        edge[b] |= differs
    return edge.ravel()


@dataclass(frozen=True, eq=False)
class View:
    """A pinhole camera in a scene."""

    T_scene_camera: Float64  # (4, 4)
    focal_px: float
    centre_px: tuple[float, float]  # principal point, column and row
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
        """Return rays (N, 3) through pixels (N, 2), scene axes, of unit depth."""
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
