"""Figures of pairs with epipolar lines, before and after rectification."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from matplotlib import colormaps
from matplotlib.axes import Axes

from recon.core.values.arrays import Float64, UInt8
from recon.report.canvas import WIDE_IN, new_figure, style_picture, to_png


@dataclass(frozen=True, eq=False)
class EpipolarPicture:
    """One image with points and the epipolar lines they should lie on.

    Attributes:
        image: uint8 (H, W) or (H, W, 3).
        pixels: float64 (N, 2), the points.
        lines: One curve (M, 2) per point; NaN = outside the image.
        title: Title of the figure.
    """

    image: UInt8
    pixels: Float64
    lines: Sequence[Float64]
    title: str


def level_lines(pixels: Float64, width_px: int) -> list[Float64]:
    """The rows of the points, as lines across the image."""
    return [np.array([[0.0, y], [width_px - 1.0, y]]) for _, y in pixels]


def epipolar_figure(left: EpipolarPicture, right: EpipolarPicture) -> bytes:
    """PNG of both images side by side; a point and its line have the same colour in both."""
    height, width = left.image.shape[:2]
    figure = new_figure(WIDE_IN, WIDE_IN / 2 * height / width + 0.4)
    for axes, picture in zip(figure.subplots(1, 2), (left, right), strict=True):
        _draw(axes, picture)
    return to_png(figure)


def spread_points(pixels: Float64, count: int = 10) -> Float64:
    """int64 (M,), indices of at most ``count`` points, evenly spread by row."""
    order = np.argsort(pixels[:, 1])
    picked = np.unique(np.linspace(0, len(order) - 1, min(count, len(order))).astype(int))
    return np.asarray(order[picked])


def _draw(axes: Axes, picture: EpipolarPicture) -> None:
    height, width = picture.image.shape[:2]
    axes.imshow(picture.image, cmap="gray", vmin=0, vmax=255)
    colours = colormaps["turbo"](np.linspace(0.08, 0.92, max(len(picture.pixels), 1)))
    for pixel, line, colour in zip(picture.pixels, picture.lines, colours, strict=True):
        axes.plot(line[:, 0], line[:, 1], color=colour, linewidth=1.1)
        axes.plot(
            *pixel, marker="o", markersize=5, color=colour, markeredgecolor="white", linestyle=""
        )
    axes.set_xlim(-0.5, width - 0.5)
    axes.set_ylim(height - 0.5, -0.5)
    style_picture(axes, picture.title)
