"""Images whose disparity is known exactly."""

from __future__ import annotations

import cv2
import numpy as np

from recon.core.values import RectifiedCamera, RectifiedPair
from recon.core.values.arrays import Float64, UInt8

HEIGHT, WIDTH = 60, 120


def make_pair(left: UInt8, right: UInt8, valid: np.ndarray | None = None) -> RectifiedPair:
    height, width = left.shape
    camera = RectifiedCamera(
        focal_px=100.0,
        cx_px=width / 2,
        cy_px=height / 2,
        cx_right_px=width / 2,
        baseline_m=0.5,
        width_px=width,
        height_px=height,
    )
    return RectifiedPair(left, right, camera, valid=valid)


def noise(height: int = HEIGHT, width: int = WIDTH, seed: int = 0) -> UInt8:
    grey = np.random.default_rng(seed).integers(0, 256, (height, width), dtype=np.uint8)
    return np.asarray(cv2.GaussianBlur(grey, (0, 0), 1.0), dtype=np.uint8)


def smooth_texture(x: Float64, y: Float64) -> UInt8:
    """A texture that is known between pixels: waves of several directions and lengths."""
    waves = np.random.default_rng(1).uniform(-1.2, 1.2, (24, 2))
    phases = np.random.default_rng(2).uniform(0, 2 * np.pi, 24)
    total = sum(np.sin(a * x + b * y + p) for (a, b), p in zip(waves, phases, strict=True))
    return np.asarray(np.clip(128 + 18 * total, 0, 255).round(), dtype=np.uint8)


def warped_pair(disparity: Float64) -> RectifiedPair:
    """Left view of a surface whose disparity is given on the grid of the *right* view."""
    y, x = np.mgrid[: disparity.shape[0], : disparity.shape[1]].astype(np.float64)
    return make_pair(smooth_texture(x, y), smooth_texture(x + disparity, y))


def square_before_wall() -> tuple[RectifiedPair, np.ndarray]:
    """A square (disparity 20) before a wall (disparity 4), and the mask of its half shadow."""
    wall, square = noise(80, 160, seed=3), noise(40, 50, seed=4)
    left, right = wall[:, :144].copy(), wall[:, 4:148].copy()
    left[20:60, 70:120] = square
    right[20:60, 50:100] = square
    # The square hides wall columns 50 to 99 of the right view, 54 to 103 of the left one.
    hidden = np.zeros(left.shape, bool)
    hidden[20:60, 54:70] = True
    return make_pair(left, right), hidden


def inner(array: np.ndarray, left: int = 40, margin: int = 8) -> np.ndarray:
    """The part of a map that both images show, off the border."""
    return array[margin:-margin, left:-margin]
