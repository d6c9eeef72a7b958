"""From radiance to pixels: antialiasing, tone curve, sensor."""

from __future__ import annotations

from typing import Final

import numpy as np

from recon.core.values.arrays import Bool, Float64, UInt8
from recon.street.materials import GAMMA
from recon.street.stage import Sample, Stage
from recon.street.view import View

_QUARTERS: Final = ((-0.25, -0.25), (0.25, -0.25), (-0.25, 0.25), (0.25, 0.25))
_CREASE: Final = 0.92  # cosine of the angle between normals, below which there is an edge
_EXPOSURE: Final = 0.9


def take_image(stage: Stage, view: View, smooth_edges: bool) -> Float64:
    """Render one view.

    Args:
        stage: The lit scene.
        view: The camera.
        smooth_edges: Cast four rays per pixel at edges.

    Returns:
        float64 (H, W, 3), display values in [0, 1].
    """
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
    """Apply a sensor model to display values.

    Args:
        image: float64 (H, W, 3) in [0, 1].
        gain: Factor on brightness.
        offset_dn: Grey levels added.
        noise_dn: Standard deviation of Gaussian noise, grey levels.
        key: Seed of the noise; equal keys give equal noise.

    Returns:
        uint8 (H, W, 3).
    """
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
    """bool (H·W,), pixels that differ from a neighbour in object, material, shadow or normal."""
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
